"""Families of organs: what a member shares with its template, how it differs, and what is refused."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from msdm_core.errors import MeshError
from msdm_core.mesh.ordering import spring_order
from msdm_core.mesh.quality import radius_ratios
from msdm_core.mesh.tet_mesh import tet_volumes
from surgsim_env.scene import family as families
from surgsim_env.scene.anatomy import Anatomy, MemberName, load_anatomy
from surgsim_env.scene.family import OrganFamily, family_of, make_member
from surgsim_env.scene.levels import LEVELS
from surgsim_env.scene.load import load_scene, make_scene, scenes_folder
from surgsim_env.scene.model import SPLITS, Family
from surgsim_env.scene.palpable_surface import contact_radius

SHIPPED = ("liver_family", "kidney_family", "spleen_family")
SHAPES = Family(
    size=(0.9, 1.1), aspect=(0.9, 1.1), thickness=(0.9, 1.1), curvature=3.0, edge=0.05, bump_count=3, bump_height=0.002,
    bump_width=(0.008, 0.015), train=3, validation=2, test=2,
)  # fmt: skip


def block(**changes) -> Anatomy:
    """A small block as the template of a family."""
    return load_anatomy(replace(make_scene("phantom_small"), family=replace(SHAPES, **changes)))


def names_of(family: Family) -> list[MemberName]:
    return [MemberName(split, number) for split in SPLITS for number in range(family.member_count(split))]


# ---- members --------------------------------------------------------------------------------------------------------


def test_members_of_all_splits_differ_and_are_made_again_to_the_bit():
    template = block()
    members = [make_member(template, name) for name in names_of(SHAPES)]
    assert len(members) == 7
    for first, other in combinations(members, 2):
        assert np.abs(first.mesh.points - other.mesh.points).max() > 1e-3
    for member in members:
        assert member.member is not None
        again = make_member(template, member.member)
        assert again.mesh.points.tobytes() == member.mesh.points.tobytes()
        assert again.face.thickness.tobytes() == member.face.thickness.tobytes()
    other = make_member(block(entropy=1), MemberName("train", 0))
    assert np.abs(other.mesh.points - members[0].mesh.points).max() > 1e-3, "another entropy, other members"
    more = make_member(block(train=50, test=9), MemberName("test", 1))
    assert more.mesh.points.tobytes() == members[-1].mesh.points.tobytes(), "a larger split has the same members first"


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_members_have_upright_cells_of_the_quality_promised(name: str):
    """And are inside the family's box, feel no cells, and hide lesions of every level."""
    template = load_anatomy(make_scene(name))
    scene, family = template.scene, template.scene.family
    assert family is not None and 2500 <= template.mesh.node_count <= 4500
    least = family.quality_share * radius_ratios(template.mesh)
    touch = contact_radius(scene.instrument.tip_radius, scene.palpation.press_depth)
    for split, number in (("train", 0), ("train", 63), ("validation", 3), ("test", 0), ("test", 15)):
        member = make_member(template, MemberName(split, number))
        assert (tet_volumes(member.mesh.points, template.mesh.tets) > 0.0).all()
        assert (radius_ratios(member.mesh) >= least).all()
        assert (member.mesh.points >= template.box[0]).all() and (member.mesh.points <= template.box[1]).all()
        assert member.palpable_cell <= touch
        for level in LEVELS.values():
            drawn = level.draw(member, np.random.default_rng(number), lesion_count=2)
            for lesion in drawn.lesions:
                member.check_inside(lesion)


def test_what_holds_and_is_pressed_moves_with_the_template():
    template = load_anatomy(make_scene("liver_family"))
    member = OrganFamily(template, "validation").member(1)
    assert member.template is template and str(member.member) == "validation 1"
    assert member.mesh.tets is template.mesh.tets and member.anchors is template.anchors
    assert member.foundations is template.foundations
    np.testing.assert_array_equal(member.face.triangles, template.face.triangles)
    np.testing.assert_array_equal(member.face.rim, template.face.rim)
    assert not np.array_equal(member.face.thickness, template.face.thickness)
    moved = member.mesh.points - template.mesh.points
    assert member.deformation is not None and np.abs(moved).max() > 0.005
    # The deformation is one of space: what lies between nodes moves between them.
    middle = template.mesh.points[template.mesh.edges].mean(axis=1)
    between = member.mesh.points[template.mesh.edges].mean(axis=1)
    assert np.abs(member.deformation(middle) - between).max() < 0.1 * np.abs(moved).max()
    point, _ = template.face.project(template.mesh.points.mean(axis=0))
    carried = template.face.carried(point, member.face)
    np.testing.assert_allclose(member.deformation(point[None])[0], carried, atol=1e-3)
    # Springs in the same order: only so can members stand side by side.
    np.testing.assert_array_equal(spring_order(member.mesh).springs, spring_order(template.mesh).springs)
    edges, other = (anatomy.specification().mesh.edges for anatomy in (template, member))
    np.testing.assert_array_equal(edges, other)
    assert [lesion.name for lesion in member.demonstration_lesions()] == [
        lesion.name for lesion in template.demonstration_lesions()
    ]


def test_size_stretches_and_thickness_do_to_the_volume_what_they_say():
    """V / V0 = s^3 t, as stretches keep the volume and a bend is a shear."""
    template = block(bump_count=0, edge=0.0)
    for name in names_of(SHAPES):
        member = make_member(template, name)
        shape = member.deformation
        assert isinstance(shape, families.MemberShape)
        ratio = member.mesh.volumes.sum() / template.mesh.volumes.sum()
        # A lattice of linear tets cuts a bent face, second order in the cell.
        assert ratio == pytest.approx(np.prod(shape.stretch), rel=2e-3)


# ---- what is refused ------------------------------------------------------------------------------------------------


def test_a_fold_is_drawn_again(monkeypatch):
    """The first shape turns tets inside out, the second flattens them, the third leaves the box: the fourth counts."""
    template, drawn = block(), []
    make, least = families.draw_shape, SHAPES.quality_share

    def draw(family, of, rng):
        shape = make(family, of, rng)
        spoiled = [
            replace(
                shape, bump_place=np.zeros((1, 3)), bump_shift=np.array([[0.02, 0, 0]]), bump_width=np.array([0.004])
            ),
            replace(shape, stretch=np.array([1.0, 1.0, 0.05])),
            replace(shape, stretch=np.array([1.6, 1.0, 1.0])),
            shape,
        ]
        drawn.append(spoiled[len(drawn)])
        return drawn[-1]

    monkeypatch.setattr(families, "draw_shape", draw)
    member = make_member(template, MemberName("train", 0))
    assert len(drawn) == 4 and member.deformation is drawn[3]
    points = [shape(template.mesh.points) for shape in drawn]
    with pytest.raises(MeshError, match=r"tet \d+ \(of \d+\) is inside out"):
        template.mesh.moved(points[0])
    flat = template.mesh.moved(points[1])
    assert (radius_ratios(flat) < least * radius_ratios(template.mesh)).any()
    assert (points[2] > template.box[1]).any()


def test_splits_and_members_that_are_none():
    template, plain = block(), load_anatomy(make_scene("phantom_small"))
    assert family_of(plain, None) is None
    family = family_of(template, None)
    assert family is not None and (family.split, family.size) == ("train", 3)
    with pytest.raises(ValueError, match="'trian'"):
        family_of(template, "trian")
    with pytest.raises(ValueError, match=r"'test'.*'phantom_small'"):
        family_of(plain, "test")
    with pytest.raises(ValueError, match="3"):
        family.member(3)
    with pytest.raises(ValueError, match="test 0"):
        family.named("test 0")
    assert family.named("train 2") is family.member(2)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"size": (0.4, 1.0)}, "size = .*0.4"),
        ({"aspect": (1.1, 1.0)}, "aspect = .*1.1"),
        ({"thickness": (1.0, float("nan"))}, "thickness"),
        ({"curvature": -1.0}, "curvature is -1"),
        ({"test": 0}, "test is 0"),
    ],
)
def test_ranges_that_are_none(changes, named):
    with pytest.raises(ValueError, match=named):
        replace(SHAPES, **changes)


# ---- files ----------------------------------------------------------------------------------------------------------


def test_a_template_stands_below_the_entries_of_its_family(tmp_path):
    (tmp_path / "block.toml").write_text(
        (scenes_folder() / "organs" / "phantom_small.toml").read_text("utf-8"), "utf-8"
    )
    file = tmp_path / "blocks.toml"
    file.write_text(
        'description = "blocks"\n[family]\ntemplate = "block.toml"\nsize = [0.9, 1.0]\n[limits]\nhard_force = 9.0\n'
    )
    scene, plain = load_scene(file), make_scene("phantom_small")
    assert scene.family == Family(size=(0.9, 1.0)) and (scene.name, scene.description) == ("blocks", "blocks")
    assert scene.limits == replace(plain.limits, hard_force=9.0)
    kept = replace(scene, family=None, name="", description="", folder=plain.folder, limits=plain.limits)
    assert kept == replace(plain, name="", description="")
