"""The field painted on the page's organ, computed in the page's process from a copy of the physics' state."""

from msdm_core.errors import OrganDivergedError
from msdm_core.mesh import FloatArray
from surgsim_apps.live.exchange_records import Paint
from surgsim_apps.live.organ_choice import chosen_organ
from surgsim_apps.live.session import Session
from surgsim_env.rendering import PAINTED_FIELDS, PaintedField


class PaintedTissue:
    """A field of the tissue of a session, with a scale that only grows until a reset or another organ or field.

    Fields:
        field: None for none
        end: of the scale [unit of the field]; 0 before the first values
    """

    def __init__(self, session: Session) -> None:
        """Begin without a field."""
        self._session = session
        self._organ, self._step = 0, -1
        self.field: PaintedField | None = None
        self.end = 0.0

    def choose(self, name: str) -> None:
        """Choose a field of PAINTED_FIELDS; any other name is none, and the physics then copies no state."""
        self.field = PAINTED_FIELDS.get(name)
        self.end, self._step = 0.0, -1
        self._session.ask(Paint(self.field is not None))

    def shares(self) -> FloatArray | None:
        """Places of the nodes on the scale, 0 to 1, (n_node,); None without a field or a new state."""
        field = self.field
        if field is None:
            return None
        record = self._session.exchange.tissue.read()
        organ, step = int(record["organ"]), int(record["step"])
        # Number 0: the physics has copied nothing yet.
        if organ == 0 or (organ, step) == (self._organ, self._step):
            return None
        anatomy, simulation = self._session.anatomy, self._session.simulation
        if organ != self._organ:
            self._model = chosen_organ(anatomy, self._session.choices[organ - 1])
        if organ != self._organ or step < self._step:
            self.end = 0.0
        self._organ, self._step = organ, step
        simulation.set_state(self._model, {name: record[name] for name in simulation.get_state()})
        try:
            values = field.node_values(self._model, simulation.fields())
        except OrganDivergedError:
            # The status text says so, and the last colours stay.
            return None
        self.end = max(self.end, field.scale_end(values[anatomy.mesh.boundary_nodes]))
        return field.shares(values, self.end)
