"""Run the notebooks of docs/notebooks in place and store what they put out: python docs/make_notebooks.py [NAME ...].

Each notebook is its own source: edit its cells, then run this. Stored outputs have no run times and no paths of the
machine; pictures are reduced to a palette. Five minutes for all, the kernels of numba compiled; pictures of organs need
OpenGL.
"""

import base64
import copy
import io
import os
import re
import sys
import tempfile
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbformat import NotebookNode
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = ROOT / "docs" / "notebooks"
# Of a cell, and until the interpreter answers [s]: a machine that is shared, and an empty cache of kernels.
CELL_TIME_MOST, START_TIME_MOST = 900, 300
METADATA = {
    "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    "language_info": {"name": "python"},
}
# A picture larger than the first gets a palette, one that is then larger than the second no dithering [bytes].
FULL_COLOUR_MOST, DITHERED_MOST = 45_000, 50_000
COLOURS = 255
PNG = "image/png"


def run_notebook(notebook: NotebookNode, folder: Path) -> NotebookNode:
    """A copy of a notebook with the outputs of a run in a folder, by the kernel of this interpreter.

    Raises:
        nbclient.exceptions.CellExecutionError: a cell that raises; has its code and its traceback.
    """
    done = copy.deepcopy(notebook)
    # Neither start-up files nor settings of the user's own IPython.
    settings = {**os.environ, "PYTHONPATH": str(ROOT), "IPYTHONDIR": str(folder / ".ipython")}
    place = {"metadata": {"path": str(folder)}}
    client = NotebookClient(
        done,
        kernel_name="python3",
        timeout=CELL_TIME_MOST,
        startup_timeout=START_TIME_MOST,
        coalesce_streams=True,
        resources=place,
    )
    client.execute(env=settings)
    return done


def cleaned(notebook: NotebookNode) -> NotebookNode:
    """A notebook to store: times, warnings and what names the machine left out, pictures small."""
    kept = copy.deepcopy(notebook)
    kept.metadata = nbformat.from_dict(METADATA)
    for number, cell in enumerate(kept.cells):
        cell.id, cell.metadata = f"cell-{number}", nbformat.from_dict({})
        if cell.cell_type == "code":
            cell.outputs = [_small(output) for output in cell.outputs if output.get("name") != "stderr"]
    return kept


def _small(output: NotebookNode) -> NotebookNode:
    if PNG in output.get("data", {}):
        picture = Image.open(io.BytesIO(base64.b64decode(output.data[PNG]))).convert("RGB")
        written = _png(picture)
        if len(written) > FULL_COLOUR_MOST:
            palette = picture.quantize(COLOURS, method=Image.Quantize.MAXCOVERAGE)
            written = _png(picture.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG))
        if len(written) > DITHERED_MOST:
            written = _png(picture.quantize(COLOURS, dither=Image.Dither.NONE))
        # The text beside a picture has its size, or the address of the object.
        output.data = nbformat.from_dict({PNG: base64.b64encode(written).decode()})
        output.metadata = nbformat.from_dict({})
    elif "text/plain" in output.get("data", {}):
        output.data["text/plain"] = re.sub(r" at 0x[0-9a-f]+", "", output.data["text/plain"])
    return output


def _png(picture: Image.Image) -> bytes:
    written = io.BytesIO()
    picture.save(written, "png", optimize=True)
    return written.getvalue()


def main(names: list[str]) -> None:
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        if names and path.stem not in names:
            continue
        begin = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            done = cleaned(run_notebook(nbformat.read(path, as_version=4), Path(folder)))
        nbformat.validate(done)
        nbformat.write(done, path)
        print(f"{path.name}: {time.perf_counter() - begin:.0f} s, {path.stat().st_size / 1e3:.0f} kB", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
