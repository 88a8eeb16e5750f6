"""A small lesion far below is not felt."""

import pytest

from surgsim_env.palpation.scores import lesion_reaches
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.levels import DrawnOrgan, find_level
from surgsim_env.scene.load import make_scene


@pytest.mark.slow
def test_deep_lesions_are_below_reach() -> None:
    """Sensor noise of `hard` is 15 mN: 30 mN of a press of some 0.2 N must come from the lesion."""
    anatomy = load_anatomy(find_level("hard").scene(make_scene("phantom")))
    shallow = anatomy.lesion_below([0.018, 0.018, 0.03], 0.008, 0.003, 8.0, "shallow")
    deep = anatomy.lesion_below([0.042, 0.042, 0.03], 0.006, 0.014, 2.5, "deep")
    felt, hidden = lesion_reaches(anatomy, DrawnOrgan((shallow, deep)))
    assert not felt.below and felt.force > felt.force_without + 0.05
    assert hidden.below and 0.0 < hidden.force - hidden.force_without < 0.01
    assert lesion_reaches(anatomy, DrawnOrgan(())) == []
