"""The command line: Hydra composes, signatures check, and every mistake is one sentence.

Hydra itself knows nothing of signatures and prints tracebacks, hence two seams: `SchemaLoader`
types each composed config before overrides reach it, and `guarded` turns errors into sentences and
exit codes.
"""

from __future__ import annotations

import importlib.util
import os
import re
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra._internal.hydra
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException
from yaml import YAMLError

from experiments.schema import UnknownKnob, check_switch, check_values, expand, suggest
from experiments.signatures import ConfigError
from experiments.store import check_folder

ROOT = Path(__file__).resolve().parents[1]
OTHER_COMMAND = re.compile(r"In '(\w+)/(\w+)': Could not override '/?(\w+)'\. No match")
OTHER_PART = re.compile(r"Could not override '(model|engine|driver|planner)'\. No match")


class SchemaLoader(ConfigLoaderImpl):
    """Hydra's loader, with every `_target_` node typed by its target's signature.

    Command-line overrides meet the typed nodes, so that a misspelt key or a wrong type fails there,
    and `--cfg job` shows every default."""

    def _compose_config_from_defaults_list(self, defaults: Any, repo: Any) -> DictConfig:
        config = super()._compose_config_from_defaults_list(defaults, repo)
        try:
            expand(config)
        except UnknownKnob as error:
            raise ConfigError(self._from_file(error, defaults, repo)) from None
        return config

    def _from_file(self, error: UnknownKnob, defaults: Any, repo: Any) -> str:
        """The sentence about a knob that a file sets: the file may have meant another choice of its group."""
        group, absent = error.path.partition(".")[0], object()
        key = f"{error.path}.{error.name}"
        chosen = next((d.config_path for d in defaults if d.config_path.startswith(f"{group}/")), "").partition("/")[2]
        for default in reversed(defaults):
            loaded = self._load_single_config(default, repo)
            if OmegaConf.select(loaded.config, key, default=absent) is absent:
                continue
            parts = [d for d in repo.load_config(default.config_path).defaults_list or [] if d.is_override()]
            meant = next((d.value for d in parts if getattr(d, "group", "").lstrip("/") == group), chosen)
            if meant == chosen:
                return f"{error} (set in {default.config_path}.yaml)"
            choice = default.config_path.replace("/", "=")
            return (
                f"{choice} sets {key}, which {group}={meant} takes but {group}={chosen} does not; "
                f"leave {group} as {choice} has it, or name scenario, model and engine instead of {choice}"
            )
        return str(error)

    def load_configuration(
        self, config_name: str | None, overrides: list[str], *args: Any, **kwargs: Any
    ) -> DictConfig:
        config = super().load_configuration(config_name, overrides, *args, **kwargs)
        check_values(config)
        if runs := OmegaConf.select(config, "runs"):
            check_folder(Path(runs))  # now: Hydra makes it before the run begins
        for override in OverridesParser.create().parse_overrides(overrides):
            if not override.is_sweep_override() and not override.is_delete():
                check_switch(config, override.key_or_group, override.value())
        return config


hydra._internal.hydra.ConfigLoaderImpl = SchemaLoader  # type: ignore[misc]  # Hydra 1.3 has no seam here


class JobFailed(Exception):
    """A run failed and has said why; the argument is the exit code."""


class Incomplete(Exception):
    """A run was stored without what failed after its engine."""

    def __init__(self, folder: Path, failures: dict[str, Exception]) -> None:
        super().__init__(f"{', '.join(failures)} failed; all else is stored in {folder}")
        self.failures = failures


def in_short(failures: dict[str, Exception]) -> dict[str, str]:
    """{what failed: one sentence}"""
    return {what: in_words(error) or f"{type(error).__name__}: {error}" for what, error in failures.items()}


def in_words(error: BaseException) -> str | None:
    """One sentence for a mistake of the person who launched the run; None for any other error."""
    if isinstance(error, MissingConfigException):
        return _missing(error)
    if isinstance(error, OverrideParseException):
        return f"cannot read the setting '{error.override}'; write key=value, and quote what the shell would split"
    if (other := OTHER_COMMAND.match(str(error))) is not None and isinstance(error, HydraException):
        group, name, part = other.groups()
        return (
            f"{group}={name} chooses a {part}, which this command has not: it is of another one "
            "(`waybayes` runs, `python -m experiments.drive` drives)"
        )
    if (part := OTHER_PART.match(str(error))) is not None and isinstance(error, HydraException):
        return (
            f"this command has no {part[1]}: `waybayes` runs a scenario, a model and an engine, "
            "`python -m experiments.drive` a scenario, a driver and a planner"
        )
    if isinstance(error, HydraException | OmegaConfBaseException):
        causes: list[BaseException] = [error]
        while (cause := causes[-1].__cause__ or causes[-1].__context__) is not None:
            causes.append(cause)
        unknown = next((c for c in causes if isinstance(c, ConfigAttributeError | ConfigKeyError)), None)
        if unknown is not None and isinstance(unknown.parent_node, DictConfig):
            return _unknown_key(unknown)
        typed = next((c for c in causes if isinstance(c, OmegaConfBaseException) and c.full_key), None)
        if typed is not None:
            return f"{typed.full_key}: {_first_line(typed)}"
        return " ".join(str(causes[0]).split()) or " ".join(str(causes[-1]).split())
    if isinstance(error, YAMLError):
        return f"a config file cannot be read: {' '.join(str(error).split())}; mend its YAML"
    program = sys.modules.get("models.program")  # where it was never imported, nobody raised its InputError
    kinds = (ConfigError, program.InputError) if program else (ConfigError,)
    return str(error) if isinstance(error, kinds) else None


def _first_line(error: Any) -> str:
    text = str(error).partition("\n")[0]
    if text.startswith("Invalid value assigned") and "is not a ListConfig" in text:
        return f"it is a list; write {error.full_key}=[...], quoted for the shell"
    return text.replace("$VALUE_TYPE", type(error.value).__name__).replace("$VALUE", str(error.value))


def _missing(error: MissingConfigException) -> str:
    group, _, name = str(error.missing_cfg_file or "").rpartition("/")
    if group and error.options:
        return f"there is no {group} called '{name}'{suggest(name, error.options)}"
    return " ".join(str(error).splitlines()[0].split())


def _unknown_key(error: Any) -> str:
    node = error.parent_node
    path = node._get_full_key(None)
    known = [key for key in node if key != "hydra" and not str(key).startswith("_")]
    owner = f"{path} has no knob" if path else "a run has no key"
    return f"{owner} '{error.key}'{suggest(str(error.key), known)}"


def complain(error: BaseException, where: str = "waybayes") -> int:
    """Print what went wrong to stderr and return the exit code: 2 for a mistake of use, 1 otherwise."""
    if isinstance(error, Incomplete):
        for what, cause in error.failures.items():
            complain(cause, f"{where}: {what}")
        print(f"{where}: {error}", file=sys.stderr, flush=True)
        return 1
    sentence = in_words(error)
    if sentence is None:
        print(f"{where} failed:", file=sys.stderr)
        traceback.print_exception(error)
        return 1
    print(f"{where}: {sentence}", file=sys.stderr, flush=True)
    return 2


def one_job(
    name: str, job_of: Callable[[dict[str, str]], Any], execute: Callable[[Any], object], show: Callable[[Path], None]
) -> None:
    """One job of the command `name`: says at once what went wrong; a sweep then goes on.

    job_of(choices of the config's groups) -> what to execute, with a folder; show(folder) prints what is stored"""
    known = HydraConfig.get()
    try:
        job = job_of(known.runtime.choices)
        try:
            execute(job)
        except Incomplete:
            show(job.folder)
            raise
        show(job.folder)
    except Exception as error:
        code = complain(error, " ".join([name, *known.overrides.task]))
        if known.mode == RunMode.MULTIRUN:
            raise JobFailed(code) from error
        sys.exit(code)


def guarded(work: Callable[[], object]) -> int:
    """Run a command; its exit code."""
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then hands errors through
    sys.path.append(os.getcwd())  # last, so that a model beside the user is found and hides nothing
    try:
        check_names()
        work()
    except JobFailed as failed:
        return int(failed.args[0])
    except (KeyboardInterrupt, BrokenPipeError):
        return 130
    except Exception as error:
        return complain(error)
    return 0


def check_names() -> None:
    """Raise ConfigError where a folder of the user's hides one of our packages."""
    for name in ("models", "inference", "planning", "experiments", "configs"):
        spec = importlib.util.find_spec(name)
        places = list(spec.submodule_search_locations or []) if spec else []
        if Path(places[0] if places else ".").resolve() != ROOT / name:
            raise ConfigError(
                f"the package '{name}' that Python finds ({places[0] if places else 'none'}) is not waybayes' own; "
                "a folder of that name hides it: call `waybayes` from elsewhere or rename the folder"
            )


def plain(config: DictConfig) -> dict[str, Any]:
    """The resolved config as plain dictionaries."""
    container = OmegaConf.to_container(config, resolve=True)
    assert isinstance(container, dict)
    return {str(key): value for key, value in container.items()}
