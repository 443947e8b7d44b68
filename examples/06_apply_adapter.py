"""Put the small adapter on its checkpoint, and take it off again: attach, save small, undo exactly.

    python examples/06_apply_adapter.py pretrained.ply pretrained_clod.safetensors [again.ply]

The adapter is what ``clod-adapt`` writes beside its PLY. It goes onto the very file it was trained
on and no other.
"""

import sys
from pathlib import Path

import torch

import clod_adapter as clod


def main(checkpoint: str, adapter_file: str, out: str = "again.ply") -> None:
    adapter = clod.load_adapter(adapter_file)
    # relative to what it was when the adapter was trained
    base = clod.load(checkpoint, origin=adapter.origin)
    before = base.gaussians

    # Attach. The fingerprint is the SHA-256 of the file, so that another checkpoint is refused.
    adapted = adapter.apply(before, base.fingerprint)
    changed = ["sigma_d", *adapter.updates, *(["far Gaussians"] if adapter.added else [])]
    print(f"changed: {', '.join(changed)}")

    # Save. Everything but the base is in the small file; the large one is made again from it, the
    # same bytes each time.
    clod.save(out, adapted, base, version=adapter.version, quality_table=adapter.quality_table)
    small, large = Path(adapter_file).stat().st_size, Path(out).stat().st_size
    print(f"wrote {out}: {large:,} bytes, of which {small:,} are the adapter's")

    # Undo. The base was never changed. Taking only the dial off is another thing: the tuned
    # attributes stay.
    untouched, plain = clod.load(checkpoint, origin=adapter.origin).gaussians, clod.detach(adapted)
    for name in adapter.updates:
        assert torch.equal(getattr(untouched, name), getattr(before, name))
        assert torch.equal(getattr(plain, name), getattr(adapted, name))
    print(
        f"without the adapter: {checkpoint}, bit for bit; without the dial alone: {len(plain):,}"
        " Gaussians"
    )


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4):
        sys.exit(__doc__)
    try:
        main(*sys.argv[1:])
    except clod.ClodError as error:
        sys.exit(f"error: {error}")
