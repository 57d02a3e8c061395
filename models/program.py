"""Read a Pyro program: simulate it, evaluate it, freeze parts of it.

A model is a callable of its evidence made of `pyro.sample` statements, batched over
leading dimensions (left of its plates, as in Pyro). Evidence is a NamedTuple: a field that is None is simulated, and an
observed site carries the name of the field that observes it.

    log p(z, y) = sum_latent log p(z_i | parents) + sum_observed log p(y_j | parents)
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import pyro
import torch
from pyro import poutine
from pyro.poutine.messenger import Messenger
from pyro.poutine.util import site_is_subsample
from torch import Tensor

Latents = dict[str, Tensor]  # site name -> (*batch, *event)
Model = Callable[[Any], None]
Site = dict[str, Any]


class InputError(ValueError):
    """One sentence for the person who launched the run: what, where, which value, what to do."""


class Terms(NamedTuple):
    """Log density of every site, events and plates summed.

    prior       {latent site: (*batch)}
    likelihood  {observed site: (*batch)}
    """

    prior: dict[str, Tensor]
    likelihood: dict[str, Tensor]


class Given(Messenger):
    """Give latent sites their values by name."""

    def __init__(self, values: Latents) -> None:
        super().__init__()
        self.values = values

    def _pyro_sample(self, msg: Any) -> None:
        if msg["is_observed"] or site_is_subsample(msg):
            return
        if msg["name"] not in self.values:
            raise InputError(
                f"latent site '{msg['name']}' has no value; the values given are for {sorted(self.values)}"
            )
        msg["value"], msg["done"] = self.values[msg["name"]], True


class _Frozen(Messenger):
    """Hold sites at constants: neither latent nor evidence."""

    def __init__(self, values: Latents) -> None:
        super().__init__()
        self.values = values
        self.met: set[str] = set()

    def _pyro_sample(self, msg: Any) -> None:
        if msg["name"] in self.values:
            if _is_evidence(msg):
                raise InputError(f"fix() freezes latents, but '{msg['name']}' is observed; change it in the evidence")
            self.met.add(msg["name"])
            value = self.values[msg["name"]]
            if not msg["fn"].support.is_discrete:
                value = value.double()  # a Normal about an integer rounds its scale to one
            msg["value"], msg["is_observed"], msg["done"] = value, True, True
            msg["infer"] = msg["infer"] | {"frozen": True}


_PROGRAMS = threading.RLock()


@contextmanager
def quiet_doubles() -> Iterator[None]:
    """Run a program in float64, without Pyro's own validation, leaving no trace of either.

    Both settings, Pyro's handlers and torch's random numbers belong to the whole process: one
    thread runs programs at a time, and seeds inside this context."""
    with _PROGRAMS:
        before = torch.get_default_dtype()
        torch.set_default_dtype(torch.float64)
        try:
            with pyro.validation_enabled(False):
                yield
        finally:
            torch.set_default_dtype(before)


def sample_sites(model: Model, evidence: Any) -> dict[str, Site]:
    """Run the program as it is; its sample sites by name."""
    nodes: dict[str, Any] = dict(poutine.trace(model).get_trace(evidence).nodes)
    return {n: site for n, site in nodes.items() if site["type"] == "sample" and not _is_bookkeeping(site)}


def _is_bookkeeping(site: Any) -> bool:
    """Of a plate, or a name for a computed value (pyro.deterministic): no random variable."""
    return bool(site_is_subsample(site) or site["infer"].get("_deterministic", False))


def sites_under(model: Model, evidence: Any, handler: Messenger) -> dict[str, Site]:
    """Run the program in float64 under a handler; its sample sites by name."""
    with quiet_doubles(), handler:
        return sample_sites(model, evidence)


def is_frozen(site: Site) -> bool:
    """Held at a value by fix()."""
    return site["infer"].get("frozen", False)


def _is_evidence(site: Site) -> bool:
    return site["is_observed"] and not is_frozen(site)


def bare_log_prob(site: Site) -> Tensor:
    """What the distribution says of its value, before support, mask and scale, (*batch, *plates)."""
    with quiet_doubles():
        return site["fn"].log_prob(site["value"])


def site_log_prob(name: str, site: Site) -> Tensor:
    """Log density of one site under its mask and scale, -inf outside its support, (*batch, *plates).

    Raises FloatingPointError with the site's name for NaN."""
    log_prob, inside = bare_log_prob(site), site["fn"].support.check(site["value"])
    if not bool(inside.all()):
        log_prob = torch.where(inside, log_prob, -torch.inf)
    if site["mask"] is not None:
        log_prob = torch.where(torch.as_tensor(site["mask"]), log_prob, 0.0)
    log_prob = log_prob * site["scale"]
    if bool(torch.isnan(log_prob).any()):
        raise FloatingPointError(f"the log density of site '{name}' is NaN")
    return log_prob


def num_plate_dims(nodes: dict[str, Site]) -> int:
    """How many dimensions, counted from the right, the program's plates take."""
    frames = (f for site in nodes.values() for f in site.get("cond_indep_stack", ()) if f.vectorized)
    return max((-frame.dim for frame in frames), default=0)


def sum_plates(log_prob: Tensor, plate_dims: int) -> Tensor:
    """Sum over the plates: (*batch, *plates) to (*batch)."""
    dims = tuple(range(-min(plate_dims, log_prob.dim()), 0))
    return log_prob.sum(dims) if dims else log_prob


def terms(model: Model, latents: Latents, evidence: Any) -> Terms:
    """Log density site by site. Raises InputError for a missing or unused latent value,
    FloatingPointError with the site's name for NaN."""
    sites = sites_under(model, evidence, Given(latents))
    unused = latents.keys() - sites.keys()
    if unused:
        raise InputError(f"values given for {sorted(unused)}, but the program has only {sorted(sites)}")
    split, plates = Terms({}, {}), num_plate_dims(sites)
    for name, site in sites.items():
        part = split.likelihood if _is_evidence(site) else split.prior
        part[name] = sum_plates(site_log_prob(name, site), plates)
    return split


def log_joint(model: Model, latents: Latents, evidence: Any) -> Tensor:
    """log p(latents, observations), (*batch)."""
    split = terms(model, latents, evidence)
    return total(split.prior) + total(split.likelihood)


def total(parts: dict[str, Tensor]) -> Tensor:
    """Sum of per-site log densities; zero where there is none."""
    return sum(parts.values(), start=torch.zeros((), dtype=torch.float64))


def simulate(model: Model, evidence: Any, *, num: int, seed: int) -> Latents:
    """Draw every unobserved site `num` times from the program, {site: (num, *event)}.

    Sites whose evidence field is None are drawn too. Randomness is local to the call."""
    with quiet_doubles(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        plates = num_plate_dims(sample_sites(model, evidence))
        with pyro.plate("_batch", num, dim=-1 - plates):
            sites = sample_sites(model, evidence)
    return {name: site["value"] for name, site in sites.items() if not site["is_observed"]}


def observe(evidence: Any, draws: Latents) -> tuple[Any, Latents]:
    """Move simulated observations into the evidence fields that are None; the rest of the draws are latents."""
    seen = {name: draws[name] for name in evidence._fields if name in draws and getattr(evidence, name) is None}
    return evidence._replace(**seen), {n: v for n, v in draws.items() if n not in seen}


@dataclass(frozen=True)
class Fixed:
    """A model with some of its sites frozen to values."""

    model: Model
    values: Latents

    def __call__(self, evidence: Any) -> None:
        with _Frozen(self.values) as frozen:
            self.model(evidence)
        missed = self.values.keys() - frozen.met
        if missed:
            raise InputError(f"fix() was given {sorted(missed)}, but the program has no site of that name; check it")


def fix(model: Model, **values: Tensor | float) -> Fixed:
    """Freeze sites at values; what remains is an ordinary program over the other sites.

    The frozen sites keep contributing their density given the latents to `log_joint`. Running the
    program raises InputError by name for a value without a site and for one whose site is observed."""
    with quiet_doubles():
        return Fixed(model, {name: torch.as_tensor(value) for name, value in values.items()})


def check(model: Model, evidence: Any) -> None:
    """Run the program twice over prior draws and raise InputError for what engines would trip on:
    a site whose density does not keep the batch, an observation outside its support."""
    try:
        draws = simulate(model, evidence, num=2, seed=0)
    except (RuntimeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        reason = str(error).splitlines()[0]
        raise InputError(
            f"the program does not run for a batch of 2 draws ({reason}); declare each site's own dimensions "
            "with .to_event()"
        ) from error
    sites = sites_under(model, evidence, Given(draws))
    plates = num_plate_dims(sites)
    for name, site in sites.items():
        if not bool(torch.isfinite(torch.as_tensor(site["value"])).all()):
            raise InputError(f"site '{name}' holds a value that is not finite")
        if site["is_observed"] and not bool(site["fn"].support.check(site["value"]).all()):
            raise InputError(f"the observation at site '{name}' lies outside the support of its distribution")
        shape = sum_plates(site_log_prob(name, site), plates).shape
        if shape not in ((2,), ()):
            raise InputError(
                f"the log density of site '{name}' has shape {tuple(shape)} for a batch of 2 draws; "
                "declare its own dimensions with .to_event()"
            )
