"""Pictures of one simulation: what the environments' `render` draws with, for use by itself too."""

import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.regions import Lesion
from surgsim_env.rendering import gl
from surgsim_env.rendering.cameras import Camera, scene_cameras
from surgsim_env.rendering.force_arrow import draw_forces
from surgsim_env.rendering.ground_shadow import ground_shadow
from surgsim_env.rendering.options import RenderOptions, check_camera
from surgsim_env.rendering.stage import LOCK, Picture, Stage, borrow_stage, give_back_stage
from surgsim_env.rendering.tissue import Tissue
from surgsim_env.simulation import Simulation
from surgsim_env.visibility import Disc


class OrganRenderer:
    """Colour, depth and labels of what a simulation looks like now; the simulation is read and never changed.

        renderer = OrganRenderer(simulation, RenderOptions(camera="endoscope"))
        frame = renderer.rgb()

    `lesions` are those that are shown where the options ask for them: assign the ones of the episode; `target` is a
    disc to be shown. OpenGL is loaded
    with the first picture. Renderers of one anatomy and size share their meshes on the graphics side.
    """

    def __init__(
        self,
        simulation: Simulation,
        options: RenderOptions | None = None,
        *,
        lesions: Sequence[Lesion] = (),
        gl_context: Any = None,
    ) -> None:
        """Nothing is loaded yet; `gl_context` is a window's, None for pictures off screen."""
        self.options = options or RenderOptions()
        aspect = self.options.width / self.options.height
        self.cameras: dict[str, Camera] = scene_cameras(simulation.anatomy, aspect)
        self.lesions: tuple[Lesion, ...] = tuple(lesions)
        self.target: Disc | None = None
        self._simulation = simulation
        self._gl_context = gl_context
        self._stage: Stage | None = None
        self._tissue: Tissue | None = None
        self._tissue_lesions: tuple[Lesion, ...] = ()

    def rgb(self, camera: str | Camera | None = None) -> NDArray[np.uint8]:
        """The picture, shape (height, width, 3), its first row on top.

        Args:
            camera: the name of one of `cameras`, or a camera of your own; that of the options if left out.

        Raises:
            ValueError: an unknown camera (lists those there are).
            NoGLError: there is no OpenGL; names the packages that are missing.
        """
        view = self._camera(camera)
        with LOCK:
            stage = self._ready_stage()
            with gl.current(stage.gl_context):
                stage.show(self._picture(stage), view)
                frame = stage.colour()
        if self.options.show_force:
            draw_forces(frame, self._simulation, view, self.options.force_mm_per_newton)
        return frame

    def depth(self, camera: str | Camera | None = None) -> NDArray[np.float32]:
        """Distance of each pixel from the camera's plane [m], infinite where there is nothing, shape (height, width).

        The surface of a translucent organ counts; the force arrow does not.
        """
        view = self._camera(camera)
        with LOCK:
            stage = self._ready_stage()
            with gl.current(stage.gl_context):
                stage.show(self._picture(stage), view)
                return stage.depth()

    def segmentation(self, camera: str | Camera | None = None) -> NDArray[np.uint8]:
        """What each pixel shows, one of `stage.LABELS`, shape (height, width).

        Lesions have pixels where the options show them; in a translucent organ those that are seen through it.
        """
        view = self._camera(camera)
        with LOCK:
            stage = self._ready_stage()
            with gl.current(stage.gl_context):
                stage.show(self._picture(stage), view)
                return stage.labels()

    def close(self) -> None:
        """Give back the graphics; the next picture loads them again."""
        if self._stage is not None:
            self._finalizer()
            self._stage = self._tissue = None

    def __getstate__(self) -> dict[str, Any]:
        """A copy draws the same and loads graphics of its own."""
        return {**self.__dict__, "_stage": None, "_tissue": None, "_finalizer": None}

    def present(self, frame: NDArray[np.uint8]) -> None:
        """Put a picture into the window whose context this renderer draws with."""
        stage = self._ready_stage()
        with LOCK, gl.current(stage.gl_context):
            stage.present(frame)

    def _camera(self, camera: str | Camera | None) -> Camera:
        if isinstance(camera, Camera):
            return camera
        name = self.options.camera if camera is None else camera
        check_camera(name)
        return self.cameras[name]

    def _ready_stage(self) -> Stage:
        if self._stage is None:
            context = gl.context() if self._gl_context is None else self._gl_context
            simulation = self._simulation
            self._stage = borrow_stage(simulation.anatomy, simulation.instrument.model, self.options, context)
            self._finalizer = weakref.finalize(self, give_back_stage, self._stage)
        return self._stage

    def _picture(self, stage: Stage) -> Picture:
        simulation, options = self._simulation, self.options
        shown = self.lesions if options.show_lesion or options.cut_away else ()
        if self._tissue is None or shown != self._tissue_lesions:
            self._tissue = Tissue(simulation.anatomy, stage.surface, shown, options.cut_away)
            self._tissue_lesions = shown
        nodes, tissue, scene = simulation.organ_state.node_position, self._tissue, stage.scene
        axes = [lesion.half_axes for lesion in tissue.lesions]
        shapes = tissue.shapes(nodes)
        if "shadow" in scene.meshes:
            up = -simulation.anatomy.downward
            shapes["shadow"] = ground_shadow(nodes, stage.surface.triangles, scene.light, scene.ground, up)
        return Picture(
            shapes=shapes,
            lesions=list(zip(tissue.lesion_centres(nodes), axes)) if options.show_lesion else [],
            instrument=simulation.instrument.data,
            target=self.target,
        )
