"""A bad option is a ValueError that names it. Needs no OpenGL."""

import pytest

from surgsim_env.rendering.options import render_options

BAD = [
    ({"camera": "front"}, "camera 'front' is unknown; the cameras are overview, endoscope, side, above"),
    ({"width": 0}, "width is 0; it must be a whole number of pixels from 1 to 4096"),
    ({"style": "plane"}, "style 'plane' is unknown; .*did you mean 'plain'"),
    ({"paint": "stres"}, "paint 'stres' is unknown; .*did you mean 'stress'"),
    ({"height": 480.0}, "height is 480.0"),
    ({"height": 5000}, "height is 5000"),
    ({"show_lesions": True}, "argument 'show_lesions'; .*did you mean 'show_lesion'"),
]


@pytest.mark.parametrize(("given", "message"), BAD, ids=lambda part: str(part)[:30])
def test_bad_options_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        render_options(given)
