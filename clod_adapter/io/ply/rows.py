"""PLY files as rows, plain and packed."""

from __future__ import annotations

from pathlib import Path

from plyfile import PlyData

from clod_adapter.io.ply.body import read_element
from clod_adapter.io.ply.columns import SIGMA, sh_degree_of
from clod_adapter.io.ply.header import PREFIX, all_comments, read_head, read_header
from clod_adapter.io.ply.packed import check_packed, is_packed, read_packed
from clod_adapter.io.rows import Rows


def check_ply(path: Path) -> None:
    """Refuses what by its header is no checkpoint.

    Raises:
        ClodError: it is none.
    """
    header = read_header(path)
    if is_packed(header):
        check_packed(path, header)
    else:
        sh_degree_of(path, header)


def ply_has_dial(path: Path) -> bool:
    """Whether the header has a sigma_d."""
    header = read_header(path)
    return "vertex" in header and SIGMA in {column.name for column in header["vertex"].properties}


def read_ply(path: Path) -> Rows:
    """The vertices of a PLY; those of a compressed one unpacked.

    Raises:
        ClodError: no checkpoint, or damaged.
    """
    head = read_head(path)
    if is_packed(head.ply):
        return read_packed(path, head)
    degree, comments = sh_degree_of(path, head.ply), all_comments(head.ply)
    ours = any(comment.startswith(PREFIX) for comment in comments)
    return Rows(read_element(path, head), degree, comments, _not_kept(head.ply), settled=ours)


def _not_kept(header: PlyData) -> tuple[str, ...]:
    """A note on the parts of the file that an output will not carry."""
    parts = [f"element {element.name}" for element in header if element.name != "vertex"]
    parts += ["obj_info"] if header.obj_info else []
    return (f"not carried over to outputs: {', '.join(parts)}",) if parts else ()
