"""What an organ is like, printed; and `surgsim organ` on a file of tets."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.table import Table

from msdm_core.kernels import OrganModel
from msdm_core.length_unit import LengthUnit
from msdm_core.mesh import TetMesh
from msdm_core.organ import OrganSpec, compile_organ
from msdm_core.quality import mesh_quality, surface_cell
from msdm_core.regions import Material
from surgsim_env.cell_share import share_text, warn_of_coarse_cells
from surgsim_env.scenes import make_scene


def report_organ(
    file: Path, length_unit: LengthUnit | None, youngs_modulus: float | None, out: Path | None, console: Console
) -> None:
    """Print what an organ made from a file of tets is like, with the shipped liver's tissue and touch, and write it.

    Raises:
        MeshError: the file cannot become an organ.
        ValueError: the length unit is missing or unknown.
    """
    from msdm_core.mesh_io import read_mesh, write_mesh

    if out is not None:
        check_target(out)
    mesh = read_mesh(file, length_unit=length_unit)
    liver = make_scene("liver")
    material = liver.material
    if youngs_modulus is not None:
        material = replace(material, youngs_modulus=youngs_modulus)
    organ = compile_organ(OrganSpec(mesh=mesh, materials=material, damping=liver.damping))
    cell = surface_cell(mesh, mesh.boundary_triangles)
    touch = (liver.instrument.tip_radius, liver.palpation.press_depth)
    print_organ(file.name, mesh, organ, material=material, volume_error=None, cell=cell, touch=touch, console=console)
    if out is not None:
        write_mesh(out, mesh)
        console.print(f"written: {out}", highlight=False, soft_wrap=True)


def print_organ(
    title: str,
    mesh: TetMesh,
    organ: OrganModel,
    *,
    material: Material,
    volume_error: float | None,
    cell: float,
    touch: tuple[float, float],
    console: Console,
    more: Mapping[str, str] | None = None,
) -> None:
    """Print a table of an organ; warns where its cells would be felt.

    Args:
        title: of the table.
        mesh: of the organ.
        organ: compiled on it.
        material: of its healthy tissue.
        volume_error: against what the mesh fills, None where that is not known.
        cell: of its surface [m].
        touch: tip radius and press depth [m].
        console: where it is printed.
        more: further rows.
    """
    quality = mesh_quality(mesh)
    fit = "no surface to compare with" if volume_error is None else f"{volume_error:+.2%}"
    x, y, z = (mesh.points.max(axis=0) - mesh.points.min(axis=0)) * 1e3
    step = f"{organ.stable_step * 1e3:.3f} ms"
    rows = {
        "extent": f"{x:.1f} x {y:.1f} x {z:.1f} mm",
        "nodes": f"{mesh.node_count}",
        "tets": f"{mesh.tet_count}, {mesh.reoriented_count} reoriented",
        "springs": f"{len(organ.spring_nodes)}",
        "volume": f"{quality.volume * 1e6:.1f} ml (error {fit})",
        **(more or {}),
        "mass": f"{organ.node_mass.sum():.4f} kg at {material.density:g} kg/m^3",
        "dihedral angles": f"{quality.dihedral_smallest_deg:.1f} to {quality.dihedral_largest_deg:.1f} degrees",
        "radius ratio": f"from {quality.radius_ratio_smallest:.3f} (1 is regular)",
        "cell / contact radius": share_text(cell, *touch),
        "stable step": f"{step} at E {material.youngs_modulus:g} Pa, nu {material.poisson_ratio:g}",
    }
    table = Table(title=title, show_header=False)
    for name, value in rows.items():
        table.add_row(name, value)
    console.print(table)
    warn_of_coarse_cells(title, cell, *touch)


def check_target(out: Path) -> None:
    """Refuse a place or a format that could not be written, before the work."""
    from msdm_core.mesh_io import FORMATS

    if out.suffix.lower() not in FORMATS:
        raise ValueError(f"--out {out}: unknown extension {out.suffix!r}; known: {', '.join(FORMATS)}")
    if not out.parent.is_dir():
        raise ValueError(f"--out {out}: the folder {out.parent} does not exist; create it first")
