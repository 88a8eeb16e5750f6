"""Report page of a patient's organ: source, mesh, tissue, palpation, scene, and pictures drawn without OpenGL."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np

from msdm_core.arithmetic import dot, matmul
from msdm_core.material import Lesion, lesion_extent
from msdm_core.mesh import FloatArray, IntArray, TetMesh, mesh_quality, outer_faces, surface_carriers
from msdm_core.organ import compile_organ, stable_dt
from surgsim_apps.palpate.hold import Hold
from surgsim_apps.palpate.sites import plan_sites
from surgsim_apps.patient.meshers import DIHEDRAL_SMALLEST
from surgsim_apps.patient.patient_scene import PatientScene
from surgsim_apps.patient.retract_scene import RetractScene, retraction_text
from surgsim_apps.patient.supports import held_text
from surgsim_apps.reports.html_page import Picture, render_page
from surgsim_apps.reports.surface_drawing import INK, PAPER, OrthographicView, Patches, draw_patches, organ_patches
from surgsim_apps.reports.turning_scene import SolidPart, TurningScene, marks_part, turning_scene
from surgsim_env.rendering import cut_edges
from surgsim_env.scene import Scene, hidden_share, share_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

VOLUME_ERROR_LARGEST = 0.02

# Cells of a table, the first of which names the row.
Rows = list[tuple[str, ...]]
TISSUE = np.array([0.72, 0.36, 0.30])
PALPABLE = np.array([0.86, 0.56, 0.45])
HELD = np.array([0.42, 0.47, 0.56])
SECTION = np.array([0.90, 0.70, 0.62])
# Colours of the regions after the first, repeated cyclically.
REGIONS = np.array([[0.95, 0.78, 0.18], [0.25, 0.55, 0.85], [0.35, 0.70, 0.45], [0.62, 0.42, 0.75], [0.92, 0.50, 0.20]])
# Opacity of an organ over its regions, and radius of a site's mark over the sites' spacing.
OPACITY, SITE_SHARE = 0.55, 0.1
# Views: direction, upward direction, and titles for the axes of a scan and for other axes.
SIDES = (
    ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), "from the front", "along y"),
    ((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0), "from the patient's left", "against x"),
    ((0.0, 0.0, -1.0), (0.0, -1.0, 0.0), "from the head", "against z"),
)


def report_page(
    organ: PatientScene, scene_text: str, scene_file: str, command: str, retraction: RetractScene | str | None = None
) -> str:
    """Text of the page.

    Args:
        organ: the organ with its scene.
        scene_text: text of the scene file.
        scene_file: its name.
        command: command line of this report.
        retraction: its scene, or the reason for none; None without a search.
    """
    outside = (
        "Top: the whole organ; bottom: cut open through the middle of its largest region, without the part nearer to "
        "the viewer. Lighter: the face that the probe can press; grey: held, fixed or on fat and ligaments."
    )
    return render_page(
        "organ.html.j2",
        generator="surgsim organ",
        title=f"Organ: {organ.scene.description}",
        verdict=verdict(organ, retraction),
        scene=organ_scene(organ),
        notes=organ.notes,
        source=_source(organ),
        volumes=_volumes(organ),
        organ_picture=Picture("From three sides", outside, organ_picture(organ)),
        mesh=_mesh(organ),
        regions=_regions(organ),
        step=_step(organ),
        palpation=_palpation(organ),
        retraction=None if retraction is None else retraction_text(retraction),
        scene_text=scene_text,
        scene_file=scene_file,
        command=command,
    )


def verdict(organ: PatientScene, retraction: RetractScene | str | None = None) -> str:
    """What can be done with the organ, what limits it, and what it is made of, in a few sentences."""
    patient, quality, lesion = organ.patient, mesh_quality(organ.patient.mesh), organ.scene.lesion
    use, limits = [f"can be pressed at {organ.site_count} sites"], []
    if lesion is None:
        limits.append("it has no room for hidden lesions")
    else:
        low, high = (f"{radius * 1e3:.3g}" for radius in lesion.radius)
        use.append(f"has room for hidden lesions of {low} to {high} mm radius")
    if isinstance(retraction, RetractScene):
        use.append("has an edge to lift")
    elif retraction is not None:
        limits.append(f"it cannot be lifted ({retraction})")
    if organ.hold is not None:
        limits += [fault.partition(";")[0] for fault in organ.hold.faults]
    if abs(patient.volume_error) > VOLUME_ERROR_LARGEST:
        limits.append("its volume is more than 2 % off (use smaller cells)")
    if quality.dihedral_smallest_deg < DIHEDRAL_SMALLEST:
        limits.append(f"a dihedral angle of {quality.dihedral_smallest_deg:.1f} degrees makes the step short")
    count, remarks = len(patient.lesions), len(organ.notes)
    sentences = [
        f"This organ {', '.join(use[:-1])}{' and ' if use[1:] else ''}{use[-1]}.",
        f"What limits: {'; '.join(limits)}." if limits else "Nothing limits it.",
        f"The mesh has {quality.volume * 1e6:.1f} ml, {patient.volume_error:+.2%} against the file, and "
        f"{count or 'no'} segmented lesion{'' if count == 1 else 's'}.",
        f"{remarks} remark{'' if remarks == 1 else 's'} below." if remarks else "",
    ]
    return " ".join(filter(None, sentences))


def _source(organ: PatientScene) -> Rows:
    patient = organ.patient
    return [
        ("files", ", ".join(patient.sources)),
        ("axes", patient.convention),
        ("mesher", f"{patient.mesher}, {patient.cells_text}"),
    ]


def _volumes(organ: PatientScene) -> Rows:
    names = [f"{organ.patient.organ_name} (whole)", *(volume.name for volume in organ.patient.volumes[1:])]
    return [
        (name, f"{volume.source * 1e6:.2f} ml", f"{volume.mesh * 1e6:.2f} ml", f"{volume.error:+.2%}")
        for name, volume in zip(names, organ.patient.volumes, strict=True)
    ]


def _mesh(organ: PatientScene) -> Rows:
    mesh = organ.patient.mesh
    quality = mesh_quality(mesh)
    x, y, z = np.ptp(mesh.points, axis=0) * 1e3
    low = " ".join(f"{value * 1e3:.1f}" for value in mesh.points.min(axis=0))
    return [
        ("nodes, tets, boundary triangles", f"{mesh.node_count}, {mesh.tet_count}, {quality.boundary_triangle_count}"),
        ("extent", f"{x:.1f} x {y:.1f} x {z:.1f} mm, from {low} mm"),
        ("dihedral angles", f"{quality.dihedral_smallest_deg:.1f} to {quality.dihedral_largest_deg:.1f} degrees"),
        ("radius ratio", f"from {quality.radius_ratio_smallest:.3f}"),
    ]


def _regions(organ: PatientScene) -> Rows:
    mesh, rows = organ.patient.mesh, Rows()
    for tag, name in mesh.region_names:
        tissue, volume = organ.tissue if tag == 1 else organ.regions[name], mesh.volumes[mesh.region == tag].sum()
        modulus, ratio = f"{tissue.material.youngs_modulus:g} Pa", f"{tissue.material.poisson_ratio:g}"
        mass = f"{volume * tissue.material.density:.4f} kg"
        rows.append((name, f"{volume * 1e6:.2f} ml", mass, modulus, ratio, tissue.source))
    return rows


def _step(organ: PatientScene) -> Rows:
    anatomy, scene = organ.anatomy, organ.scene
    model = compile_organ(anatomy.specification(anatomy.demonstration_lesions()))
    capsule, in_contact = scene.capsule, stable_dt(model, scene.contact.law)
    shell = "none" if capsule is None else f"{capsule.youngs_modulus:g} Pa, {capsule.thickness or 0.0:g} m"
    return [
        ("total mass", f"{model.node_mass.sum():.4f} kg"),
        ("springs", f"{len(model.spring_nodes)}"),
        ("held by", "; ".join(held_text(anchor) for anchor in scene.anchors)),
        ("fixed and elastically held nodes", f"{len(anatomy.anchors)} and {len(anatomy.foundation_nodes)}"),
        ("capsule", f"{shell}, over {len(model.surface_triangles)} free boundary triangles"),
        ("stable step", f"{model.stable_step * 1e3:.3f} ms, in contact {in_contact * 1e3:.3f} ms"),
        ("substeps in a haptic step of 1 ms", f"{scene.timing.substep_count}"),
    ]


def _palpation(organ: PatientScene) -> Rows:
    scene, palpation = organ.scene, organ.scene.palpation
    tip, depth = scene.instrument.tip_radius, palpation.press_depth
    x, y, z = scene.instrument.approach
    return [
        ("tip and press", f"ball of {tip * 1e3:g} mm radius, {depth * 1e3:g} mm deep"),
        ("approach", f"{x:g}, {y:g}, {z:g}"),
        ("sites", f"{organ.site_count}, {palpation.site_spacing * 1e3:g} mm apart"),
        ("cell / contact radius", share_text(organ.anatomy.palpable_cell, tip, depth)),
        ("contact", "not checked" if organ.hold is None else _hidden_text(organ.hold, scene)),
        ("held", "not checked" if organ.hold is None else organ.hold.text),
        ("force limits", f"{scene.limits.soft_force:g} and {scene.limits.hard_force:g} N"),
    ]


def _hidden_text(hold: Hold, scene: Scene) -> str:
    """`hidden_share` over a lesion with twice the force and the slope of the hardest healthy press, in words."""
    force, slope, contact = 2.0 * float(hold.force.max()), 2.0 * float(hold.slope.max()), scene.contact.stiffness
    share = hidden_share(force, slope, scene.instrument.tip_radius, scene.palpation.press_depth, contact)
    return (
        f"contact of {contact:.3g} N/m^3 hides about {share:.1%} of the contrast over 1 where a press feels "
        f"{force:.2f} N, twice as much as a healthy one"
    )


def organ_scene(organ: PatientScene) -> TurningScene:
    """The organ as the probe sees it, translucent over its regions, with the sites of its presses."""
    from matplotlib.colors import to_hex

    mesh = organ.anatomy.mesh
    surface, triangles = organ.anatomy.outer_surface
    rows, index = np.unique(triangles, return_inverse=True)
    points = surface[rows]
    tints = [(name, _region_colours(mesh)[tag], tag) for tag, name in mesh.region_names[1:]]
    # A point has the colour of the boundary triangle below it.
    colours = _outer_colours(organ)[surface_carriers(points, mesh).triangle]
    parts = [
        SolidPart(name, mesh.points, outer_faces(mesh.tets[mesh.region == tag])[0], to_hex(colour.tolist()))
        for name, colour, tag in tints
    ]
    sites, _, _ = plan_sites(organ.anatomy)
    parts.append(marks_part("sites", sites, SITE_SHARE * organ.scene.palpation.site_spacing, INK))
    opacity = OPACITY if tints else 1.0
    parts.append(SolidPart("organ", points, index.reshape(-1, 3).astype(np.int32), colours, opacity))
    named = [
        ("palpable face", PALPABLE),
        ("held", HELD),
        ("free", TISSUE),
        *((name, colour) for name, colour, _ in tints),
    ]
    legend = [*((name, to_hex(colour.tolist())) for name, colour in named), (f"{len(sites)} sites to press", INK)]
    approach, up = np.array(organ.scene.instrument.approach), np.array(organ.scene.cranial)
    upright = up if abs(dot(approach, up)) < 0.9 else None
    return turning_scene(
        parts, OrthographicView.along(approach, upright), "The organ as the probe approaches it.", legend
    )


def organ_picture(organ: PatientScene) -> bytes:
    """PNG of three views: at the top whole with palpable face and anchors, below cut open through a region."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.5, 8.6), dpi=100, facecolor=PAPER, layout="constrained")
    axes = figure.subplots(2, 3)
    mesh = organ.anatomy.mesh
    patches = organ_patches(organ.anatomy)
    colours = _outer_colours(organ)[patches.origin]
    through = _through(organ)
    for column, (along, up, of_scan, of_file) in enumerate(SIDES):
        view = OrthographicView.along(np.array(along), up=np.array(up))
        draw_patches(axes[0, column], [(patches, colours, 0.12)], view)
        _draw_cut(axes[1, column], mesh, patches, colours, through, view)
        axes[0, column].set_title(of_scan if organ.patient.is_scan else of_file, color=INK, fontsize=11)
        axes[1, column].set_title("cut open there", color=INK, fontsize=11)
    for cell in axes.flat:
        cell.set_aspect("equal")
        cell.set_axis_off()
    _scale_bar(axes[0, 0], mesh)
    _legend(figure, organ)
    return _png(figure)


def _outer_colours(organ: PatientScene) -> FloatArray:
    """Colours of the boundary triangles (n_triangle, 3)."""
    mesh, anatomy = organ.anatomy.mesh, organ.anatomy
    triangles = mesh.boundary_triangles
    colours = np.broadcast_to(TISSUE, (len(triangles), 3)).copy()
    palpable = {tuple(row) for row in anatomy.face.triangles.tolist()}
    colours[[tuple(row) in palpable for row in triangles.tolist()]] = PALPABLE
    held = np.concatenate([anatomy.anchors, anatomy.foundation_nodes])
    colours[np.isin(triangles, held).all(axis=1)] = HELD
    tags = mesh.region[mesh.boundary_tets]
    for tag, colour in _region_colours(mesh).items():
        colours[tags == tag] = colour
    return colours


def _region_colours(mesh: TetMesh) -> dict[int, FloatArray]:
    return {tag: REGIONS[number % len(REGIONS)] for number, (tag, _) in enumerate(mesh.region_names[1:])}


def _through(organ: PatientScene) -> FloatArray:
    """A point on the cutting planes [m]: the centre of the largest region, lesions first, or of the organ."""
    mesh = organ.anatomy.mesh
    inner = organ.patient.volumes[1:]
    if not inner:
        return matmul(mesh.volumes, mesh.points[mesh.tets].mean(axis=1)) / mesh.volumes.sum()
    largest = max(inner, key=lambda volume: (volume.name in organ.patient.lesions, volume.mesh)).name
    return lesion_extent(mesh, Lesion(region=largest, material=organ.tissue.material, name=largest))[0]


def _draw_cut(
    axes: Axes, mesh: TetMesh, patches: Patches, colours: FloatArray, through: FloatArray, view: OrthographicView
) -> None:
    """Draw the part behind the plane through a point across the view, and the section in its regions' colours."""
    from matplotlib.collections import PolyCollection

    behind = matmul(patches.corners.mean(axis=1) - through, view.towards) < 0.0
    kept = Patches(patches.corners[behind], patches.normals[behind], patches.origin[behind])
    draw_patches(axes, [(kept, colours[behind], 0.12)], view)
    polygons, tags = section(mesh, through, view.towards)
    tints = _region_colours(mesh)
    faces = np.array([tints.get(int(tag), SECTION) for tag in tags]).reshape(-1, 3)
    flat = [view.flat(polygon) for polygon in polygons]
    axes.add_collection(PolyCollection(flat, facecolors=faces, edgecolors=0.8 * faces, linewidths=0.25, zorder=3))
    axes.autoscale_view()


def section(mesh: TetMesh, through: FloatArray, normal: FloatArray) -> tuple[list[FloatArray], IntArray]:
    """Sections of tets with a plane: polygons of 3 or 4 points [m] and the tets' region tags."""
    height = matmul(mesh.points - through, normal)
    polygons: list[FloatArray] = []
    cut = []
    for tets, edges in cut_edges(mesh.tets, height):
        start, end = height[edges[..., 0]], height[edges[..., 1]]
        share = (start / (start - end))[..., None]
        polygons.extend(mesh.points[edges[..., 0]] * (1.0 - share) + mesh.points[edges[..., 1]] * share)
        cut.append(tets)
    owner = np.concatenate(cut)
    order = np.argsort(owner)
    return [polygons[index] for index in order], mesh.region[owner[order]]


def _scale_bar(axes: Axes, mesh: TetMesh) -> None:
    length = 50.0 if np.ptp(mesh.points, axis=0).max() > 0.08 else 10.0
    low, bottom = axes.get_xlim()[0], axes.get_ylim()[0]
    axes.plot([low, low + length], [bottom, bottom], color=INK, lw=2.5)
    axes.annotate(f"{length:g} mm", (low, bottom), (0, 4), textcoords="offset points", color=INK, fontsize=9)


def _legend(figure: Figure, organ: PatientScene) -> None:
    from matplotlib.patches import Patch

    mesh = organ.anatomy.mesh
    names = dict(mesh.region_names)
    entries = [(PALPABLE, "palpable face"), (HELD, "held"), (SECTION, f"{organ.patient.organ_name}, cut")]
    entries += [(colour, names[tag]) for tag, colour in _region_colours(mesh).items()]
    figure.legend(
        handles=[Patch(color=tuple(colour), label=name) for colour, name in entries[:10]],
        loc="outside lower center",
        ncols=5,
        frameon=False,
    )


def _png(figure: Figure) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", facecolor=PAPER, metadata={"Software": None})
    return stream.getvalue()
