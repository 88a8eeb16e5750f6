"""What a benchmark says: figures with a case, a quantity, a unit; what is absent and why; sections of them."""

from dataclasses import dataclass, field


class AbsentError(Exception):
    """Something that this run cannot measure, such as a peer that is not installed; the message says why."""


@dataclass(frozen=True)
class Figure:
    """One number: of which case, which quantity, in which unit; None where there is none, and then `note` says why."""

    case: str
    quantity: str
    value: float | None
    unit: str
    note: str = ""

    @property
    def text(self) -> str:
        """The value with four digits, or "absent"."""
        return "absent" if self.value is None else f"{self.value:.4g}"


@dataclass(frozen=True)
class Section:
    """A part of the report: a short key, a heading, what was measured and how, the figures, and a closing text."""

    key: str
    heading: str
    method: str
    figures: list[Figure] = field(default_factory=list)
    closing: str = ""

    def lines(self) -> list[str]:
        """`name value unit`, one line a figure; names have no blanks."""
        lines = []
        for figure in self.figures:
            name = f"{self.key}/{figure.case}/{figure.quantity}".replace(" ", "_")
            why = f" ({figure.note})" if figure.value is None else ""
            lines.append(f"{name} {figure.text} {figure.unit}{why}")
        return lines

    def markdown(self) -> str:
        """Heading, method, and a table: cases down, quantities across, notes last."""
        cases = list(dict.fromkeys(figure.case for figure in self.figures))
        columns = list(dict.fromkeys((figure.quantity, figure.unit) for figure in self.figures))
        noted = any(figure.note for figure in self.figures)
        headings = ["", *(f"{quantity} [{unit}]" for quantity, unit in columns), *(["note"] if noted else [])]
        lines = [f"## {self.heading}\n", self.method + "\n"]
        if self.figures:
            lines += ["| " + " | ".join(headings) + " |", "|---|" + "---:|" * len(columns) + "---|" * noted]
        for case in cases:
            own = [figure for figure in self.figures if figure.case == case]
            by_column = {(figure.quantity, figure.unit): figure.text for figure in own}
            texts = [case, *(by_column.get(column, "") for column in columns)]
            if noted:
                texts.append("; ".join(dict.fromkeys(figure.note for figure in own if figure.note)))
            lines.append("| " + " | ".join(text.replace("|", "\\|") for text in texts) + " |")
        return "\n".join(lines) + (f"\n\n{self.closing}" if self.closing else "") + "\n"


def absent(case: str, quantity: str, unit: str, why: object) -> Figure:
    """A figure that could not be had, and why, in one line."""
    return Figure(case, quantity, None, unit, " ".join(str(why).split()))
