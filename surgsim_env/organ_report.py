"""What `surgsim organ` does: build an organ from a file, report on it, write its mesh."""

from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.table import Table

from msdm_core.length_unit import LengthUnit
from msdm_core.mesh import TetMesh
from msdm_core.organ import OrganSpec, compile_organ
from msdm_core.quality import MeshQuality, mesh_quality, surface_cell
from surgsim_env.cell_share import share_text, warn_of_coarse_cells
from surgsim_env.scenes import make_scene


def report_organ(
    file: Path,
    length_unit: LengthUnit | None,
    cell_size: float,
    youngs_modulus: float | None,
    out: Path | None,
    console: Console,
) -> None:
    """Print what an organ made from a file is like, with the shipped liver's tissue and touch, and write its mesh.

    Raises:
        MeshError: the file cannot become an organ.
        ValueError: the length unit is missing or unknown.
    """
    if out is not None:
        _check_target(out)
    mesh, quality = _read(file, length_unit, cell_size)
    liver = make_scene("liver")
    material = liver.material
    if youngs_modulus is not None:
        material = replace(material, youngs_modulus=youngs_modulus)
    organ = compile_organ(OrganSpec(mesh=mesh, materials=material, damping=liver.damping))
    fit = "no surface to compare with" if quality.volume_error is None else f"{quality.volume_error:+.2%}"
    x, y, z = (mesh.points.max(axis=0) - mesh.points.min(axis=0)) * 1e3
    cell = surface_cell(mesh, mesh.boundary_triangles)
    touch = (liver.instrument.tip_radius, liver.palpation.press_depth)
    step = f"{organ.stable_step * 1e3:.3f} ms"
    rows = {
        "extent": f"{x:.1f} x {y:.1f} x {z:.1f} mm",
        "nodes": f"{mesh.node_count}",
        "tets": f"{mesh.tet_count}, {mesh.reoriented_count} reoriented",
        "springs": f"{len(organ.spring_nodes)}",
        "volume": f"{quality.volume * 1e6:.1f} ml (error {fit})",
        "mass": f"{organ.node_mass.sum():.4f} kg at {material.density:g} kg/m^3",
        "dihedral angles": f"{quality.dihedral_smallest_deg:.1f} to {quality.dihedral_largest_deg:.1f} degrees",
        "radius ratio": f"from {quality.radius_ratio_smallest:.3f} (1 is regular)",
        "cell / contact radius": share_text(cell, *touch),
        "stable step": f"{step} at E {material.youngs_modulus:g} Pa, nu {material.poisson_ratio:g}",
    }
    table = Table(title=file.name, show_header=False)
    for name, value in rows.items():
        table.add_row(name, value)
    console.print(table)
    warn_of_coarse_cells(file.name, cell, *touch)
    if out is not None:
        from msdm_core.mesh_io import write_mesh

        write_mesh(out, mesh)
        console.print(f"written: {out}", highlight=False, soft_wrap=True)


def _check_target(out: Path) -> None:
    """Refuse a place or a format that could not be written, before the work."""
    from msdm_core.mesh_io import FORMATS

    if out.suffix.lower() not in FORMATS:
        raise ValueError(f"--out {out}: unknown extension {out.suffix!r}; known: {', '.join(FORMATS)}")
    if not out.parent.is_dir():
        raise ValueError(f"--out {out}: the folder {out.parent} does not exist; create it first")


def _read(file: Path, length_unit: LengthUnit | None, cell_size: float) -> tuple[TetMesh, MeshQuality]:
    from msdm_core.mesh_io import read_mesh, read_surface
    from msdm_core.meshing import mesh_surface
    from msdm_core.surface_io import SURFACE_SUFFIXES

    if file.suffix.lower() not in SURFACE_SUFFIXES:
        mesh = read_mesh(file, length_unit=length_unit)
        return mesh, mesh_quality(mesh)
    if length_unit is None:
        raise ValueError(f'{file}: needs --length-unit: "m", "cm", "mm" or metres per unit; its format states none')
    vertices, triangles = read_surface(file, length_unit=length_unit)
    mesh = mesh_surface(vertices, triangles, cell_size=cell_size)
    return mesh, mesh_quality(mesh, (vertices, triangles))
