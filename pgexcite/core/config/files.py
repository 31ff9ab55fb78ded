"""Reading a scenario as plain data: the file, the files it includes underneath, and overrides from the command line."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any

from pgexcite.core.config.tables import SINGLE_TABLES, TOP_LEVEL
from pgexcite.core.errors import ConfigError, Problem
from pgexcite.core.registry import nearest


def read(path: Path | str) -> dict[str, Any]:
    """A scenario file merged over the files it includes; ``include`` is relative to the file it stands in.

    Raises:
        ConfigError: a file is missing, is not TOML, or includes itself.
    """
    return _read(Path(path), ())


def merge(under: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """``over`` laid over ``under``, table by table.

    Lists (of events, say) are replaced as a whole. So is a table that names another ``model``: the parameters of the model
    underneath would mean nothing to it.
    """
    if "model" in under and "model" in over and under["model"] != over["model"]:
        return deepcopy(dict(over))
    merged = deepcopy(dict(under))
    for key, value in over.items():
        below = merged.get(key)
        merged[key] = merge(below, value) if isinstance(below, dict) and isinstance(value, dict) else deepcopy(value)
    return merged


def override(data: Mapping[str, Any], settings: Sequence[str]) -> dict[str, Any]:
    """Data with ``path=value`` settings applied; a value is read as TOML, or taken as text where it is none.

    Elements of lists are addressed by position (``event.0.R=0.05``). A new ``model`` drops the parameters of the former one.

    Raises:
        ConfigError: a setting is malformed or its path leads nowhere; all of them are reported.
    """
    result = deepcopy(dict(data))
    problems: list[Problem] = []
    pairs = [setting.partition("=") for setting in settings]
    for path, sign, text in sorted(pairs, key=lambda pair: not pair[0].strip().endswith(".model")):
        if not sign or not path.strip():
            problems.append(Problem("--set", "should be path=value, as in unit.G2.exciter.K_A=250", path + sign + text))
            continue
        problem = _assign(result, path.strip().split("."), _value(text.strip()))
        if problem is not None:
            problems.append(problem)
    if problems:
        raise ConfigError(problems)
    return result


def _read(path: Path, including: tuple[Path, ...]) -> dict[str, Any]:
    if path.resolve() in including:
        raise ConfigError([Problem("include", "a file includes itself, directly or through others", str(path))])
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        where = str(including[-1]) + ": include" if including else str(path)
        raise ConfigError([Problem(where, f"cannot be read: {error.strerror}", str(path))]) from error
    except UnicodeDecodeError as error:
        raise ConfigError([Problem(str(path), f"is not UTF-8 text: {error.reason} at byte {error.start}")]) from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError([Problem(str(path), f"is not valid TOML: {error}", hint=_advice(str(error)))]) from error
    included = data.pop("include", [])
    names = [included] if isinstance(included, str) else included
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ConfigError([Problem("include", "should be a file name or a list of file names", included)])
    under: dict[str, Any] = {}
    for name in names:
        under = merge(under, _read(path.parent / name, (*including, path.resolve())))
    return merge(under, data)


def _advice(message: str) -> str:
    if "Cannot declare" in message or "Cannot overwrite" in message:
        return "a name is used twice at that line: rename one of the two, or join them"
    return "strings need quotes, tables stand in [brackets], list entries like events in [[double brackets]]"


def _value(text: str) -> Any:
    try:
        parsed = tomllib.loads(f"value = {text}")
    except tomllib.TOMLDecodeError:
        return text
    return parsed["value"] if len(parsed) == 1 else text


def _assign(data: dict[str, Any], parts: list[str], value: Any) -> Problem | None:
    """Set one value in place; returns what is wrong with its path, if anything."""
    node: Any = data
    for depth, part in enumerate(parts):
        where = ".".join(parts[: depth + 1])
        last = depth == len(parts) - 1
        if isinstance(node, list):
            if not part.isdecimal() or int(part) >= len(node):
                return Problem(
                    where, f"there is no such entry; entries 0 to {len(node) - 1} exist", hint="count from zero"
                )
            if last:
                node[int(part)] = value
            else:
                node = node[int(part)]
        elif not isinstance(node, dict):
            return Problem(where, "leads into a value, not into a table", node)
        elif last:
            if part == "model" and node.get("model", value) != value:
                node.clear()
            node[part] = value
        elif part in node:
            node = node[part]
        elif depth >= 2 or (depth == 0 and part in SINGLE_TABLES):
            node = node.setdefault(part, {})
        else:
            return Problem(where, "there is no such table", hint=nearest(part, TOP_LEVEL if depth == 0 else node))
    return None
