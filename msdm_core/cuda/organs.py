"""Vectorised organs of one mesh on a CUDA device: arrays and launches."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from cuda.bindings import driver  # pyright: ignore[reportAttributeAccessIssue]
from numba import cuda
from numpy.typing import NDArray

from msdm_core.arithmetic import exp
from msdm_core.cuda.device_functions import SIMULATED, DeviceFunctions
from msdm_core.cuda.organ_steps import (
    FLAG_COUNT,
    DeviceModel,
    DeviceState,
    Scratch,
    StepNumbers,
    Tools,
    advance_lanes,
    advance_organ,
    working_size,
)
from msdm_core.errors import OrganError
from msdm_core.kernels.contact_kernels import PLACE_WIDTH, QUADRATURE_COUNT, ROW_WIDTH
from msdm_core.kernels.structure_kernels import (
    FAULT_NONE,
    LANE_EMPTY,
    ContactLaw,
    ContactShapes,
    OrganModel,
    OrganState,
)

# Fields of a model with a value for each lane.
OWN = ("node_mass", "node_inverse_mass", "node_bulk", "spring_stiffness", "tet_bulk", "tet_averaged_bulk")
KEPT = ("node_position", "node_velocity", "contact_engaged", "contact_stretch", "contact_passed")
# Threads of a block, and registers of a multiprocessor.
THREADS, REGISTERS = 512, 2**16


def check_device() -> None:
    """Require a CUDA device.

    Raises:
        RuntimeError: no device, or no driver or compiler for it.
    """
    if not cuda.is_available():
        raise RuntimeError(
            "no usable CUDA device: `nvidia-smi` must list a device, and CUDA's compiler must be installed, for "
            'instance by pip install "numba-cuda[cu13]"; device="cpu" needs neither'
        )


def shared_memory() -> int:
    """Largest shared memory of a block [bytes]; of the simulator, that of most devices."""
    if SIMULATED:
        return 2**16
    return cuda.get_current_device().MAX_SHARED_MEMORY_PER_BLOCK_OPTIN


def multiprocessors() -> int:
    """Number of multiprocessors of the device; 1 for the simulator."""
    return 1 if SIMULATED else cuda.get_current_device().MULTIPROCESSOR_COUNT


def with_shared_memory(kernel: Any, arguments: tuple[Any, ...], size: int) -> Any:
    """Kernel compiled for its arguments with more shared memory than 48 KiB, `size` [bytes]."""
    if SIMULATED:
        return kernel
    special = kernel.specialize(*arguments)
    compiled = next(iter(special.overloads.values()))._codelibrary.get_cufunc()
    attribute = driver.CUfunction_attribute.CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES
    handle, device = driver.CUkernel(int(compiled.handle)), cuda.get_current_device().id
    (code,) = driver.cuKernelSetAttribute(attribute, size, handle, device)
    if code != driver.CUresult.CUDA_SUCCESS:
        raise RuntimeError(f"the device refuses {size} bytes of shared memory for a block: {code!r}")
    return special


def incidence(items: NDArray[np.integer], count: int) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Number of items (n, m) at each node, and their indices in `items.ravel()`: (count,), (count, most)."""
    nodes = items.ravel()
    order = np.argsort(nodes, kind="stable")
    number = np.bincount(nodes, minlength=count)
    places = np.arange(len(nodes)) - np.repeat(np.cumsum(number) - number, number)
    entries = np.zeros((count, number.max()), dtype=np.int64)
    entries[nodes[order], places] = order
    return number.astype(np.int32), entries


def topology(organ: OrganModel, dtype: Any) -> dict[str, NDArray]:
    """Fields of `DeviceModel` common to all lanes."""
    nodes, tets, springs = len(organ.node_mass), organ.tet_nodes, organ.spring_nodes
    index = np.uint16 if max(nodes, len(tets), len(springs)) < 2**16 else np.int32
    tet_count, tet_entries = incidence(tets, nodes)
    # Corners of the face opposite to a, b, c and d, in the order of the gradient.
    opposite = np.array([[1, 3, 2], [0, 2, 3], [0, 3, 1], [0, 1, 2]])
    tet, corner = tet_entries // 4, tet_entries % 4
    node_tets = np.concatenate([tet[..., None], tets[tet[..., None], opposite[corner]]], axis=2)
    spring_count, spring_entries = incidence(springs, nodes)
    spring, end = spring_entries // 2, spring_entries % 2
    node_springs = np.stack([spring, springs[spring, 1 - end]], axis=2)
    facet_count, facets = incidence(organ.surface_triangles, nodes)
    outer = np.flatnonzero(facet_count)
    foundation = np.full(nodes, -1, dtype=np.int32)
    foundation[organ.foundation_nodes] = np.arange(len(organ.foundation_nodes))
    return {
        "tet_nodes": tets.astype(index),
        "tet_inverse_volume": organ.tet_inverse_volume.astype(dtype),
        "spring_nodes": springs.astype(index),
        "spring_rest_length": organ.spring_rest_length.astype(dtype),
        "node_inverse_volume": organ.node_inverse_volume.astype(dtype),
        "surface_triangles": organ.surface_triangles.astype(np.int32),
        "surface_rest_area": organ.surface_rest_area.astype(dtype),
        "foundation_position": organ.foundation_position.astype(dtype),
        "foundation_stiffness": organ.foundation_stiffness.astype(dtype),
        "gravity": organ.gravity.astype(dtype),
        "node_tet_count": tet_count,
        "node_tets": np.ascontiguousarray(node_tets.transpose(1, 0, 2).astype(index)),
        "node_spring_count": spring_count,
        "node_springs": np.ascontiguousarray(node_springs.transpose(1, 0, 2).astype(index)),
        "node_foundation": foundation,
        "surface_nodes": outer.astype(np.int32),
        "facet_count": facet_count[outer],
        "facets": facets[outer].astype(np.int32),
    }


def check_organ(organ: OrganModel) -> None:
    """Refuse an organ with parts beyond the device's kernels.

    Raises:
        OrganError: names the part.
    """
    parts = {
        "springs that stiffen": organ.stiffens,
        "springs that relax": organ.relaxes,
        "supports": len(organ.support_kind) > 0,
        "a ground that moves": len(organ.motion_node_shift) > 0,
        "Rayleigh's beta": organ.beta > 0.0,
    }
    for name, is_present in parts.items():
        if is_present:
            raise OrganError(f'a CUDA device does not compute {name}: advance this organ with device="cpu"')


class DeviceArrays(NamedTuple):
    """Arrays of organs for a device, on the host, with all lanes empty."""

    model: DeviceModel
    state: DeviceState
    scratch: Scratch
    tools: Tools

    @classmethod
    def of(
        cls, organ: OrganModel, lanes: int, shapes: ContactShapes, dtype: Any, *, blocks: int, threads: int, room: int
    ) -> "DeviceArrays":
        """Arrays for organs of one mesh, with `room` numbers of each block outside of shared memory."""
        nodes, tets = len(organ.node_mass), len(organ.tet_nodes)
        surface, shape_count, tools = len(organ.surface_triangles), len(shapes.shape_radius), len(shapes.tool_centre)
        slots = shape_count * surface
        points = QUADRATURE_COUNT * slots

        def zeros(*shape: int, dtype: Any = dtype) -> NDArray:
            return np.zeros(shape, dtype=dtype)

        def whole(*shape: int) -> NDArray:
            return zeros(*shape, dtype=np.int32)

        model = DeviceModel(**topology(organ, dtype), **{name: zeros(lanes, len(getattr(organ, name))) for name in OWN})
        state = DeviceState(
            node_position=zeros(lanes, nodes, 3),
            node_velocity=zeros(lanes, nodes, 3),
            contact_engaged=zeros(lanes, shape_count, surface * QUADRATURE_COUNT, dtype=np.uint8),
            contact_stretch=zeros(lanes, shape_count, surface * QUADRATURE_COUNT, 3),
            contact_passed=whole(lanes, 2),
            volume_ratio_smallest=zeros(lanes),
            fault=np.full(lanes, LANE_EMPTY, dtype=np.int32),
        )
        scratch = Scratch(
            flags=whole(blocks, FLAG_COUNT),
            counts=whole(blocks, threads),
            candidates=whole(blocks, shape_count, surface),
            entry=whole(blocks, shape_count, surface),
            listed=whole(blocks, slots, 2),
            rows=zeros(blocks, points, ROW_WIDTH),
            places=whole(blocks, points, PLACE_WIDTH),
            touched=whole(blocks, len(model.surface_nodes)),
            hold=zeros(blocks, nodes),
            squeezed=whole(blocks, tets),
            pool=zeros(blocks, room),
        )
        return cls(
            model,
            state,
            scratch,
            Tools(
                radius=shapes.shape_radius.astype(dtype),
                tool=shapes.shape_tool.astype(np.int32),
                friction=shapes.shape_friction.astype(dtype),
                ends=zeros(lanes, shape_count, 2, 3),
                span=zeros(lanes, shape_count, 3),
                centre=zeros(lanes, tools, 3),
                twist=zeros(lanes, tools, 6),
                acceleration=zeros(lanes, tools, 6),
                mobility=zeros(lanes, tools, tools, 6, 6),
                pushed=zeros(lanes, tools, 6),
                lag=zeros(lanes, tools, 6),
                reference=zeros(lanes, tools, 3),
                mean=zeros(lanes, tools, 6),
            ),
        )


def _on_device(record: Any) -> Any:
    """Copy of a record of arrays on the device."""
    return type(record)(*(cuda.to_device(array) for array in record))


class DeviceOrgans:
    """Organs of one mesh on a device, each with its moduli, masses, state and tools.

    A launch is one haptic step or several: a block of threads advances an organ, or all blocks a single organ.
    """

    def __init__(
        self,
        organ: OrganModel,
        lane_count: int,
        shapes: ContactShapes,
        contact: ContactLaw,
        dt: float,
        substep_count: int,
        *,
        dtype: Any = np.float32,
        threads: int = THREADS,
        registers: int | None = None,
        block_count: int | None = None,
    ) -> None:
        """Allocate arrays on the device; all lanes are empty until `put`.

        Args:
            organ: with the mesh, anchors and foundations of all lanes.
            lane_count: number of organs.
            shapes: of the tools of one lane.
            contact: law of all lanes.
            dt: substep [s].
            substep_count: substeps in a haptic step.
            dtype: np.float32 or np.float64.
            threads: of a block, a power of 2.
            registers: of a thread; by default all of a multiprocessor for one block.
            block_count: blocks; by default all that run at a time, at most one for each lane.

        Raises:
            RuntimeError: no CUDA device.
            OrganError: parts of an organ beyond the device's kernels.
        """
        check_device()
        check_organ(organ)
        self.dtype, self.threads = np.dtype(dtype).type, threads
        real = self.dtype
        nodes, tets, springs = len(organ.node_mass), len(organ.tet_nodes), len(organ.spring_nodes)
        size = np.dtype(real).itemsize
        room = working_size(nodes, tets, springs)
        sums = 6 * threads * size
        limit = shared_memory()
        self.is_shared = lane_count > 1 and sums + room * size <= limit
        self.shared_bytes = sums + (room * size if self.is_shared else 0)
        if block_count is None:
            block_count = multiprocessors() * (max(1, limit // (self.shared_bytes + 1024)) if lane_count > 1 else 1)
        self.block_count = min(block_count, lane_count) if lane_count > 1 else block_count
        blocks = self.block_count if lane_count > 1 else 1

        arrays = DeviceArrays.of(
            organ, lane_count, shapes, real, blocks=blocks, threads=threads, room=1 if self.is_shared else room
        )
        self.model, self.state = _on_device(arrays.model), _on_device(arrays.state)
        self.scratch, self.tools = _on_device(arrays.scratch), _on_device(arrays.tools)
        self.law = ContactLaw(*(real(value) for value in contact))
        self._numbers = (real(dt), real(exp(-organ.alpha * dt)), substep_count)
        self.lane_count = lane_count
        self._ready: Any = None
        functions = DeviceFunctions(real, SHARED=self.is_shared)
        self._kernel = functions.kernel(
            advance_organ if lane_count == 1 else advance_lanes, registers or min(255, REGISTERS // threads)
        )

    def put(self, organs: Sequence[OrganModel], states: Sequence[OrganState]) -> None:
        """Put organs of the same mesh with their states into all lanes, repeated in turn."""
        lanes = np.arange(self.lane_count) % len(organs)
        for name in OWN:
            self._write(getattr(self.model, name), np.stack([getattr(organ, name) for organ in organs])[lanes])
        for name in KEPT:
            self._write(getattr(self.state, name), np.stack([getattr(state, name) for state in states])[lanes])
        lowest = np.concatenate([state.volume_ratio_smallest for state in states])
        self._write(self.state.volume_ratio_smallest, lowest[lanes])
        self._write(self.state.fault, np.full(self.lane_count, FAULT_NONE))

    @staticmethod
    def _write(array: Any, values: NDArray) -> None:
        array.copy_to_device(np.ascontiguousarray(values.astype(array.dtype)))

    def put_tools(self, lane_shapes: ContactShapes, response: Any) -> None:
        """Place the tools of all lanes, with their response; arrays as of `advance_lanes`, the lane as first index."""
        pairs = {
            "ends": lane_shapes.shape_ends,
            "span": lane_shapes.shape_span,
            "centre": lane_shapes.tool_centre,
            "twist": lane_shapes.tool_twist,
            "acceleration": response.tool_acceleration,
            "mobility": response.tool_mobility,
        }
        for name, values in pairs.items():
            self._write(getattr(self.tools, name), values)

    def advance(self, step_count: int = 1) -> None:
        """Advance all lanes without fault by `step_count` haptic steps; returns before they are done."""
        numbers = StepNumbers(*self._numbers, step_count)
        arguments = (self.model, self.state, self.scratch, self.tools, self.law, numbers)
        if self._ready is None:
            self._ready = with_shared_memory(self._kernel, arguments, self.shared_bytes)
        self._ready[self.block_count, self.threads, 0, self.shared_bytes](*arguments)
