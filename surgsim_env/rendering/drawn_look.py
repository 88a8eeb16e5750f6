"""Look of a drawn scene: colours, gloss, vessels and lights of its model."""

import mujoco
import numpy as np

from surgsim_env.instruments.tool_bodies import SUPPORT_PREFIX
from surgsim_env.rendering.looks import Look
from surgsim_env.rendering.options import RenderOptions
from surgsim_env.rendering.scene_model import TARGET_COLOUR, VESSELS, SceneModel
from surgsim_env.rendering.vessels import vessel_texture

# Meshes of tissue, and brightness of "held" relative to "organ".
TISSUE = ("organ", "held")
HELD_BRIGHTNESS = 1.2
# Brightness of supports relative to the drape.
SUPPORT_BRIGHTNESS = 0.85
_RGB, _ROLES = int(mujoco.mjtTextureRole.mjTEXROLE_RGB), int(mujoco.mjtTextureRole.mjNTEXROLE)


class DrawnLook:
    """Current look of a drawn scene; None is the scene's own."""

    def __init__(self, scene: SceneModel, context: mujoco.MjrContext, options: RenderOptions) -> None:
        """Keep the scene's own colours and lights; a cut-away organ has no vessels, a painted one keeps its paint."""
        self._scene, self._context = scene, context
        model, head = scene.model, scene.model.vis.headlight
        self._changed = [
            (array, np.array(array))
            for array in (
                *(model.mat_rgba, model.mat_specular, model.mat_shininess, model.geom_rgba),
                *(model.light_diffuse, model.light_specular, scene.data.light_xdir),
                *(head.ambient, head.diffuse, head.specular),
            )
        ]
        names = [model.material(index).name for index in range(model.nmat)]
        is_painted = options.paint is not None
        self._tissue = [] if is_painted else [names.index(name) for name in TISSUE if name in names]
        self._drape = [names.index(name) for name in ("drape",) if name in names]
        drawn = scene.instrument.target
        support = np.array([model.geom(index).name.startswith(SUPPORT_PREFIX) for index in drawn], dtype=np.bool_)
        self._supports, self._instrument = drawn[support], drawn[~support]
        self._vessels = model.texture(VESSELS).id if not (options.cut_away or is_painted) else -1
        self._worn: Look | None = None

    @property
    def target_colour(self) -> tuple[float, float, float]:
        """Colour of a target disc."""
        return TARGET_COLOUR if self._worn is None else self._worn.target

    def put_on(self, look: Look | None) -> None:
        """Replace the current look."""
        if look == self._worn:
            return
        for array, own in self._changed:
            array[:] = own
        self._worn = look
        textured = self._vessels if look is not None else -1
        for material in self._tissue:
            self._context.mat_texid[_ROLES * material + _RGB] = textured
        if look is None:
            return
        model, data = self._scene.model, self._scene.data
        for material, brightness in zip(self._tissue, (1.0, HELD_BRIGHTNESS)):
            model.mat_rgba[material, :3] = np.minimum(brightness * np.array(look.tissue), 1.0)
            model.mat_specular[material], model.mat_shininess[material] = look.gloss, look.sharpness
        model.mat_rgba[self._drape, :3] = look.drape
        model.geom_rgba[self._supports, :3] = SUPPORT_BRIGHTNESS * np.array(look.drape)
        model.geom_rgba[self._instrument, :3] = np.minimum(look.instrument * model.geom_rgba[self._instrument, :3], 1.0)
        for light in range(model.nlight):
            model.light_diffuse[light] *= look.lamp
            model.light_specular[light] *= look.lamp
            data.light_xdir[light] = look.lit(data.light_xdir[light], self._scene.downward)
        for colour in (model.vis.headlight.ambient, model.vis.headlight.diffuse, model.vis.headlight.specular):
            colour[:] = colour * np.array(look.head)
        if textured >= 0:
            texture = vessel_texture(look.seed, look.vessel_density, look.vessel_strength, look.vessel_width)
            first = model.tex_adr[textured]
            model.tex_data[first : first + texture.size] = texture.ravel()
            mujoco.mjr_uploadTexture(model, self._context, textured)
