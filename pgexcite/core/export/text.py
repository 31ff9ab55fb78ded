"""Names, comments and fields as C."""

from __future__ import annotations

from collections.abc import Sequence

from pgexcite.core.export.parts import Input


def listed(names: Sequence[str]) -> str:
    """Names with their positions, for a comment."""
    return "\n".join(f"     {k:3d}  {comment(name)}" for k, name in enumerate(names)) or "     none"


def comment(text: str) -> str:
    """Text that ends no comment and begins none."""
    return text.replace("*/", "* /").replace("/*", "/ *")


def input_words(name: str, inputs: Sequence[Input]) -> dict[str, str]:
    """What the templates of header and replay are to know of a controller's input."""
    named = [(item.name, item.elements) for item in inputs if item.elements is not None]
    return {
        "orders": "".join(f"   Order of {field}:\n{listed(elements)}\n" for field, elements in named),
        "sizes": "\n".join(f"    {name.upper()}_N_{field.upper()} = {len(elements)}," for field, elements in named),
        "inputs": "\n".join(_field(item) for item in inputs),
        "reading": " &&\n           ".join(_reading(item) for item in inputs),
    }


def told_words(name: str, told: Sequence[str]) -> dict[str, str | int]:
    """What they are to know of what it answers beside the command."""
    if not told:
        return {"told_order": "", "told_size": "", "outputs": "", "n_told": 0, "told": "NULL"}
    return {
        "told_order": f"   Order of estimate:\n{listed(told)}\n",
        "told_size": f"    {name.upper()}_N_ESTIMATE = {len(told)},\n",
        "outputs": f"\n    double estimate[{len(told)}]; /* what is believed, whether a plan was found or not */",
        "n_told": len(told),
        "told": "out.estimate",
    }


def _field(item: Input) -> str:
    dimension = "" if item.size is None else f"[{max(1, item.size)}]"
    return f"    {item.kind} {item.name}{dimension}; /* {comment(item.comment)} */"


def _reading(item: Input) -> str:
    address = f"&in->{item.name}" if item.size is None else f"in->{item.name}"
    return f"read_{item.kind}(file, {address}, {1 if item.size is None else item.size})"
