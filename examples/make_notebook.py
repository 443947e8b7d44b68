"""Run ``notebook.ipynb`` from top to bottom and store its outputs in it.

    pip install nbclient ipykernel
    python examples/make_notebook.py

It takes a minute on one core. Timings and the last digits differ between machines.
"""

from __future__ import annotations

from pathlib import Path

import nbformat
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).with_name("notebook.ipynb")


def main() -> None:
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    NotebookClient(notebook, timeout=600, record_timing=False).execute()
    notebook.metadata = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    for cell in notebook.cells:
        if cell.cell_type == "code":  # without progress bars, which were cleared, and with images once
            cell.outputs = [each for each in cell.outputs if each.get("name") != "stderr"]
            for each in cell.outputs:
                if "image/jpeg" in each.get("data", {}):
                    del each.data["image/png"]
    nbformat.write(notebook, NOTEBOOK)


if __name__ == "__main__":
    main()
