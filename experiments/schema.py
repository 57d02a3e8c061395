"""Config schemas generated from signatures.

A config node with a `_target_` may hold what the target's signature names, and nothing else:

    engine:                                   inference.rjmcmc.run(model, evidence, *, seed,
      _target_: inference.rjmcmc.run    ->                         num_steps: int = 5000, ...)
      _partial_: true                         becomes a typed node {num_steps: 5000, ...}

A node with `_partial_: true` becomes a function that still awaits what run() supplies.
"""

from __future__ import annotations

import difflib
import functools
from collections.abc import Iterable, Iterator
from dataclasses import field, make_dataclass
from typing import Any, get_args

from omegaconf import MISSING, BooleanNode, Container, DictConfig, IntegerNode, ListConfig, OmegaConf

from experiments.signatures import ConfigError, Knob, knobs, locate

SUPPLIED = frozenset(  # by run() and drive(), to partial targets
    {"model", "evidence", "scans", "scene", "posterior", "posteriors", "seed", "drive", "route", "planner"}
)


class UnknownKnob(ConfigError):
    """A key of the node at `path` that its target does not take."""

    def __init__(self, path: str, name: str, known: Iterable[str]) -> None:
        super().__init__(f"{path} has no knob '{name}'{suggest(name, known)}")
        self.path, self.name = path, name


def suggest(name: str, known: Iterable[Any]) -> str:
    """'; did you mean ...?', or the list of what there is."""
    names = sorted(map(str, known))
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.6)
    return f"; did you mean '{close[0]}'?" if close else f"; there is {', '.join(names) or 'none'}"


def _targets(config: Container, path: str = "") -> Iterator[tuple[Any, Any, str, DictConfig]]:
    """(parent, key, path, node) of every node with a `_target_`, innermost first."""
    keys = range(len(config)) if isinstance(config, ListConfig) else [k for k in config if k != "hydra"]
    for key in keys:
        node = config._get_node(key)
        if isinstance(node, Container) and not node._is_none() and not node._is_missing():
            here = f"{path}.{key}" if path else str(key)
            yield from _targets(node, here)
            if isinstance(node, DictConfig) and "_target_" in node:
                yield config, key, here, node


def _settable(node: Any) -> dict[str, Knob]:
    supplied = SUPPLIED if node.get("_partial_", False) else frozenset()
    return {name: knob for name, knob in knobs(node["_target_"]).items() if name not in supplied}


def expand(config: DictConfig) -> None:
    """Give every node with a `_target_` the typed schema of its signature, in place.

    Plain numbers and switches beside them keep the type they have. Raises ConfigError for a key
    that a target does not take; OmegaConf raises for a value of the wrong type."""
    for parent, key, path, node in list(_targets(config)):
        allowed = _allowed(path, node)
        for name, knob in allowed.items():
            if name in node and not OmegaConf.is_missing(node, name):
                if knob.kind is bool:
                    _refuse_number(f"{path}.{name}", node[name])
                elif isinstance(found := node._get_node(name), ListConfig) and _leaf(knob.kind) is float:
                    node[name] = _floats(OmegaConf.to_container(found))
        entries: list[Any] = [("_target_", str, node["_target_"])]
        entries += [("_partial_", bool, field(default=True))] if node.get("_partial_", False) else []
        entries += [(k.name, k.kind, _default(k.default)) for k in allowed.values()]
        schema = OmegaConf.structured(make_dataclass("Schema", entries, kw_only=True))
        parent[key] = OmegaConf.merge(schema, node)
    for key, value in config.items():
        if isinstance(value, bool | int):
            config[key] = (BooleanNode if isinstance(value, bool) else IntegerNode)(value, is_optional=False)


def _leaf(kind: Any) -> Any:
    """Of what lists of lists are."""
    while arguments := get_args(kind):
        kind = arguments[0]
    return kind


def _floats(value: Any) -> Any:
    """Whole numbers as floats, in lists of lists, too: OmegaConf takes them for floats in plain lists only."""
    if isinstance(value, list):
        return [_floats(item) for item in value]
    return float(value) if type(value) is int else value


def _allowed(path: str, node: DictConfig) -> dict[str, Knob]:
    """The knobs of a node. Raises UnknownKnob for a key that is none."""
    allowed = _settable(node)
    for name in map(str, node):
        if name not in allowed and name not in ("_target_", "_partial_"):
            raise UnknownKnob(path, name, allowed)
    return allowed


def _default(value: Any) -> Any:
    if isinstance(value, tuple | list):
        return field(default_factory=lambda: list(value))
    if isinstance(value, dict):
        return field(default_factory=lambda: dict(value))
    return field(default=value)


def check_switch(config: DictConfig, key: str, value: Any) -> None:
    """Raise ConfigError for a number where a switch is: OmegaConf takes every number but 0 for true."""
    parent, _, name = key.rpartition(".")
    node = OmegaConf.select(config, parent) if parent else config
    if isinstance(node, DictConfig) and name in node and isinstance(node._get_node(name), BooleanNode):
        _refuse_number(key, value)


def _refuse_number(key: str, value: Any) -> None:
    if isinstance(value, int | float) and not isinstance(value, bool):
        raise ConfigError(f"{key} is a switch, but is {value}; give true or false")


def check_values(config: DictConfig) -> None:
    """Raise ConfigError for what no type catches: an added key, a value its Literal does not list."""
    for _, _, path, node in _targets(config):
        for name, knob in _allowed(path, node).items():
            if knob.choices and not OmegaConf.is_missing(node, name) and node[name] not in knob.choices:
                raise ConfigError(f"{path}.{name} is '{node[name]}'{suggest(str(node[name]), knob.choices)}")


def _as_tuples(value: Any) -> Any:
    """Lists as tuples, lists inside them, too: settings are hashed."""
    return tuple(_as_tuples(item) for item in value) if isinstance(value, list) else value


def build(node: Any, path: str = "") -> Any:
    """Call what a resolved config node names; a partial node becomes a function awaiting the rest.

    Raises ConfigError for an argument without a value."""
    if isinstance(node, list):
        return [build(item, f"{path}[{i}]") for i, item in enumerate(node)]
    if not isinstance(node, dict):
        return node
    if "_target_" not in node:
        return {key: build(value, f"{path}.{key}" if path else str(key)) for key, value in node.items()}
    arguments = {}
    for name, knob in _settable(node).items():
        value = node.get(name, MISSING)
        if value == MISSING and knob.required:
            later = f", or _partial_: true in {path} if the command gives it" if name in SUPPLIED else ""
            raise ConfigError(f"{path}.{name} has no value; give one with {path}.{name}=...{later}")
        if value != MISSING:
            value = build(value, f"{path}.{name}")
            arguments[name] = _as_tuples(value) if knob.is_tuple else value
    function = locate(node["_target_"])
    return functools.partial(function, **arguments) if node.get("_partial_", False) else function(**arguments)
