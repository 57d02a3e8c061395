"""The arguments of a function or class, read from its source without importing it.

Help and dry runs then need no torch, and a target outside the tree works like one inside. Where a
default is no plain constant, the module is imported after all.
"""

from __future__ import annotations

import ast
import functools
import importlib
import importlib.util
import inspect
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, Optional

from omegaconf import MISSING

PLAIN: dict[str, type] = {"int": int, "float": float, "str": str, "bool": bool, "Path": Path}
Definition = ast.FunctionDef | ast.ClassDef
Argument = tuple[str, ast.expr | None, ast.expr | None]  # name, annotation, default


class ConfigError(ValueError):
    """One sentence about a config: which key, which value, what to do."""


class Knob(NamedTuple):
    """One argument a config may set; `default` is MISSING where a config cannot show it."""

    name: str
    kind: Any  # type of the config node
    default: Any
    required: bool
    choices: tuple[Any, ...] = ()
    is_tuple: bool = False


def source_of(module: str) -> Path | None:
    """The file of a module, found without importing it; None where there is none."""
    top, *rest = module.split(".")
    spec = importlib.util.find_spec(top)
    if spec is None or (not rest and spec.submodule_search_locations is None):
        return Path(spec.origin) if spec and spec.origin else None
    for place in spec.submodule_search_locations or ():
        stem = Path(place, *rest)
        for file in (stem / "__init__.py", stem.with_suffix(".py")):
            if file.is_file():
                return file
    return None


@functools.cache
def knobs(target: str) -> dict[str, Knob]:
    """The arguments of a function or class by its dotted path. Raises ConfigError where there is none."""
    module, _, name = target.rpartition(".")
    found = _find(module, name) if module else None
    if found is None:
        raise ConfigError(f"_target_ '{target}' does not exist; give the importable path of a function or class")
    home, node = found
    arguments = _fields(home, node) if isinstance(node, ast.ClassDef) else _parameters(home, node)
    result = {}
    for argument, annotation, default in arguments:
        value, readable = MISSING, default is None or _is_made(home, default)
        if not readable and default is not None:
            value, readable = _constant(home, default)
        if not readable:
            return _imported_knobs(target)
        result[argument] = _knob(argument, annotation, value, default is None)
    return result


@functools.cache
def _tree(module: str) -> ast.Module | None:
    file = source_of(module)
    return ast.parse(file.read_text()) if file else None


def _find(module: str, name: str) -> tuple[str, Definition] | None:
    """Module and syntax tree of a definition, followed through `from x import y`."""
    for node in tree.body if (tree := _tree(module)) else ():
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == name:
            return module, node
        if isinstance(node, ast.ImportFrom) and any((a.asname or a.name) == name for a in node.names):
            original = next(a.name for a in node.names if (a.asname or a.name) == name)
            return _find(_absolute(module, node), original)
    return None


def _absolute(module: str, node: ast.ImportFrom) -> str:
    if not node.level:
        return node.module or ""
    file = source_of(module)
    package = module if file and file.name == "__init__.py" else module.rpartition(".")[0]
    return importlib.util.resolve_name("." * node.level + (node.module or ""), package)


def _parameters(module: str, node: ast.FunctionDef) -> Iterator[Argument]:
    """(name, annotation, default) of a function's parameters."""
    positional = node.args.posonlyargs + node.args.args
    defaults = [None] * (len(positional) - len(node.args.defaults)) + list(node.args.defaults)
    pairs = [*zip(positional, defaults, strict=True), *zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True)]
    for argument, default in pairs:
        if argument.arg != "self":
            yield argument.arg, argument.annotation, default


def _fields(module: str, node: ast.ClassDef) -> list[Argument]:
    """(name, annotation, default) of a class: its __init__, or its dataclass fields, bases first."""
    for part in node.body:
        if isinstance(part, ast.FunctionDef) and part.name == "__init__":
            return list(_parameters(module, part))
    fields: dict[str, Argument] = {}
    for base in node.bases:
        found = _find(module, base.id) if isinstance(base, ast.Name) else None
        if found and isinstance(found[1], ast.ClassDef):
            fields |= {entry[0]: entry for entry in _fields(found[0], found[1])}
    for part in node.body:
        if isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name):
            if "ClassVar" not in ast.unparse(part.annotation):
                fields[part.target.id] = (part.target.id, part.annotation, part.value)
    return list(fields.values())


def _constant(module: str, node: ast.expr) -> tuple[Any, bool]:
    """The value of a default made of literals, `math` and constants of its module; (None, False) otherwise."""
    names: dict[str, Any] = {"math": math, "__builtins__": {}}
    used = {n.id for n in ast.walk(node) if isinstance(n, ast.Name)} - names.keys()
    for statement in tree.body if used and (tree := _tree(module)) else ():
        if isinstance(statement, ast.Assign) and isinstance(statement.targets[0], ast.Name):
            if statement.targets[0].id in used:
                names[statement.targets[0].id], _ = _constant(module, statement.value)
    try:
        value = eval(compile(ast.Expression(node), module, "eval"), names)
    except Exception:
        return None, False
    return (value, True) if _is_plain(value) else (None, False)


def _is_made(module: str, default: ast.expr) -> bool:
    """Whether a default is an object of a class, `Limits()` or `field(default_factory=Limits)`: no config shows it."""
    if isinstance(default, ast.Call) and isinstance(default.func, ast.Name) and default.func.id == "field":
        factory = next((word.value for word in default.keywords if word.arg == "default_factory"), None)
        default = factory.body if isinstance(factory, ast.Lambda) else ast.Call(factory, [], []) if factory else default
    if not isinstance(default, ast.Call) or not isinstance(default.func, ast.Name):
        return False
    found = _find(module, default.func.id)
    return found is not None and isinstance(found[1], ast.ClassDef)


def _is_plain(value: Any) -> bool:
    if isinstance(value, list | tuple):
        return all(_is_plain(v) for v in value)
    if isinstance(value, dict):
        return all(isinstance(k, str) and _is_plain(v) for k, v in value.items())
    return value is None or isinstance(value, int | float | str | bool | Path)


def _imported_knobs(target: str) -> dict[str, Knob]:
    """The same from the imported object, for defaults that only running code can tell.

    A default that no config can show stays MISSING there, and the target uses its own."""
    result = {}
    for name, parameter in inspect.signature(locate(target)).parameters.items():
        annotation = parameter.annotation
        text = annotation if isinstance(annotation, str) else getattr(annotation, "__name__", "Any")
        default, required = parameter.default, parameter.default is parameter.empty
        value = default if not required and _is_plain(default) else MISSING
        result[name] = _knob(name, ast.parse(text, mode="eval").body, value, required)
    return result


def _knob(name: str, annotation: ast.expr | None, default: Any, required: bool) -> Knob:
    kind, choices, is_tuple = _kind(annotation)
    return Knob(name, kind, default, required, choices, is_tuple or isinstance(default, tuple))


def _kind(node: ast.expr | None) -> tuple[Any, tuple[Any, ...], bool]:
    """(type of the config node, choices of a Literal, whether a tuple); Any where OmegaConf has no such type."""
    match node:
        case ast.Name(id=name) if name in PLAIN:
            return PLAIN[name], (), False
        case ast.BinOp(left=left, op=ast.BitOr(), right=ast.Constant(value=None)):
            kind, choices, is_tuple = _kind(left)
            return (Any if kind is Any else Optional[kind]), (*choices, *([None] if choices else [])), is_tuple  # noqa: UP045
        case ast.Subscript(value=ast.Name(id="Literal"), slice=inner):
            values = ast.literal_eval(inner)
            values = values if isinstance(values, tuple) else (values,)
            return (str if all(isinstance(v, str) for v in values) else Any), values, False
        case ast.Subscript(value=ast.Name(id="tuple" | "list" | "Sequence" as outer), slice=inner):
            items = [i for i in (inner.elts if isinstance(inner, ast.Tuple) else [inner]) if ast.unparse(i) != "..."]
            kinds = {_kind(item)[0] for item in items}
            same = kinds.pop() if len(kinds) == 1 else Any
            return (Any if same is Any else list[same]), (), outer != "list"  # type: ignore[valid-type]
    return Any, (), False


def locate(target: str) -> Callable[..., Any]:
    """Import what a dotted path names."""
    module, _, name = target.rpartition(".")
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"_target_ '{target}' cannot be imported: {error}") from error
