"""Fitted spring factors in a file beside the organ's, so that a large organ is fitted once and not in every process."""

import hashlib
from dataclasses import asdict
from pathlib import Path

import numpy as np

from msdm_core.errors import OrganError
from msdm_core.fitting import FitReport, SpringFit, keep_fit, spring_fit
from msdm_core.mesh import TetMesh


def write_fit(path: Path, mesh: TetMesh) -> SpringFit:
    """Write a mesh's fit, made where it has none yet, with a fingerprint of the mesh; returns it."""
    fit = spring_fit(mesh)
    arrays = {"edge_factor": fit.edge_factor, "tet_factor": fit.tet_factor}
    with path.open("wb") as file:
        np.savez_compressed(file, fingerprint=_fingerprint(mesh), **arrays, **asdict(fit.report))
    return fit


def read_fit(path: Path, mesh: TetMesh) -> SpringFit:
    """Read a fit written by `write_fit` and make it the mesh's, so that `stiffness_rule="fitted"` need not fit.

    Raises:
        OrganError: the file is no such file, or belongs to another mesh.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            table = {name: file[name] for name in file.files}
        owner = str(table["fingerprint"])
        report = FitReport(**{name: table[name].item() for name in FitReport.__dataclass_fields__})
        fit = SpringFit(table["edge_factor"], table["tet_factor"], report)
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise OrganError(f"{path} cannot be read as fitted springs ({error}): make it with write_fit") from None
    if owner != _fingerprint(mesh):
        raise OrganError(f"{path} holds springs fitted to another mesh than {mesh!r}: make it anew with write_fit")
    fit.edge_factor.setflags(write=False)
    fit.tet_factor.setflags(write=False)
    return keep_fit(mesh, fit)


def _fingerprint(mesh: TetMesh) -> str:
    """SHA-256 of points, tets and regions."""
    parts = (mesh.points, mesh.tets, mesh.region)
    return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()
