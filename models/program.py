"""Read a Pyro program: simulate it, evaluate it, whiten it, freeze parts of it.

A model is a callable of its evidence made of `pyro.sample` statements, batched over
leading dimensions (left of its plates, as in Pyro). Evidence is a NamedTuple: a field that is None is simulated, and an
observed site carries the name of the field that observes it.

    log p(z, y) = sum_latent log p(z_i | parents) + sum_observed log p(y_j | parents)
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import pyro
import torch
from pyro import poutine
from pyro.distributions import ExpandedDistribution, MaskedDistribution
from pyro.poutine.messenger import Messenger
from pyro.poutine.util import site_is_subsample
from torch import Tensor
from torch import distributions as dist

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


class _Given(Messenger):
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


class _Whitened(Messenger):
    """Give latent sites their values as maps of standard normal numbers."""

    def __init__(self, numbers: dict[str, Tensor]) -> None:
        super().__init__()
        self.numbers = numbers

    def _pyro_sample(self, msg: Any) -> None:
        if not msg["is_observed"] and not site_is_subsample(msg):
            number = self.numbers[msg["name"]]
            msg["value"], msg["done"] = _from_standard(msg["name"], msg["fn"], number), True


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


def _sample_sites(model: Model, evidence: Any) -> dict[str, Site]:
    nodes: dict[str, Any] = dict(poutine.trace(model).get_trace(evidence).nodes)
    return {n: site for n, site in nodes.items() if site["type"] == "sample" and not _is_bookkeeping(site)}


def _is_bookkeeping(site: Any) -> bool:
    """Of a plate, or a name for a computed value (pyro.deterministic): no random variable."""
    return bool(site_is_subsample(site) or site["infer"].get("_deterministic", False))


def _sites(model: Model, evidence: Any, handler: Messenger) -> dict[str, Site]:
    """Run the program under a handler; its sample sites by name."""
    with quiet_doubles(), handler:
        return _sample_sites(model, evidence)


def _is_frozen(site: Site) -> bool:
    return site["infer"].get("frozen", False)


def _is_evidence(site: Site) -> bool:
    return site["is_observed"] and not _is_frozen(site)


def _log_prob(site: Site) -> Tensor:
    with quiet_doubles():
        return site["fn"].log_prob(site["value"])


def _site_log_prob(name: str, site: Site) -> Tensor:
    """Log density of one site, -inf outside its support, (*batch, *plates)."""
    log_prob, inside = _log_prob(site), site["fn"].support.check(site["value"])
    if not bool(inside.all()):
        log_prob = torch.where(inside, log_prob, -torch.inf)
    if site["mask"] is not None:
        log_prob = torch.where(torch.as_tensor(site["mask"]), log_prob, 0.0)
    log_prob = log_prob * site["scale"]
    if bool(torch.isnan(log_prob).any()):
        raise FloatingPointError(f"the log density of site '{name}' is NaN")
    return log_prob


def _plate_dims(nodes: dict[str, Site]) -> int:
    """How many dimensions, counted from the right, the program's plates take."""
    frames = (f for site in nodes.values() for f in site.get("cond_indep_stack", ()) if f.vectorized)
    return max((-frame.dim for frame in frames), default=0)


def _sum_plates(log_prob: Tensor, plate_dims: int) -> Tensor:
    dims = tuple(range(-min(plate_dims, log_prob.dim()), 0))
    return log_prob.sum(dims) if dims else log_prob


def terms(model: Model, latents: Latents, evidence: Any) -> Terms:
    """Log density site by site. Raises InputError for a missing or unused latent value,
    FloatingPointError with the site's name for NaN."""
    sites = _sites(model, evidence, _Given(latents))
    unused = latents.keys() - sites.keys()
    if unused:
        raise InputError(f"values given for {sorted(unused)}, but the program has only {sorted(sites)}")
    split, plates = Terms({}, {}), _plate_dims(sites)
    for name, site in sites.items():
        part = split.likelihood if _is_evidence(site) else split.prior
        part[name] = _sum_plates(_site_log_prob(name, site), plates)
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
        plates = _plate_dims(_sample_sites(model, evidence))
        with pyro.plate("_batch", num, dim=-1 - plates):
            sites = _sample_sites(model, evidence)
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
    sites = _sites(model, evidence, _Given(draws))
    plates = _plate_dims(sites)
    for name, site in sites.items():
        if not bool(torch.isfinite(torch.as_tensor(site["value"])).all()):
            raise InputError(f"site '{name}' holds a value that is not finite")
        if site["is_observed"] and not bool(site["fn"].support.check(site["value"]).all()):
            raise InputError(f"the observation at site '{name}' lies outside the support of its distribution")
        shape = _sum_plates(_site_log_prob(name, site), plates).shape
        if shape not in ((2,), ()):
            raise InputError(
                f"the log density of site '{name}' has shape {tuple(shape)} for a batch of 2 draws; "
                "declare its own dimensions with .to_event()"
            )


# Whitening: a latent value is a map of standard normal numbers, an observation is compared in
# standard deviations.


WRAPPERS = (dist.Independent, MaskedDistribution, ExpandedDistribution)


def _unwrap(fn: Any) -> Any:
    """The distribution inside Independent, Masked and Expanded wrappers."""
    while isinstance(fn, WRAPPERS):
        fn = fn.base_dist
    return fn


def _describe(fn: Any) -> str:
    return type(_unwrap(fn)).__name__


def _from_standard(name: str, fn: Any, number: Tensor) -> Tensor:
    base = _unwrap(fn)
    if isinstance(base, dist.Normal):
        return base.loc + base.scale * number
    if isinstance(base, dist.MultivariateNormal):
        return base.loc + (base.scale_tril @ number[..., None])[..., 0]
    if isinstance(base, dist.TransformedDistribution):
        value = _from_standard(name, base.base_dist, number)
        for transform in base.transforms:
            value = transform(value)
        return value
    if isinstance(base, dist.Uniform):
        return base.low + (base.high - base.low) * torch.special.ndtr(number)
    raise _no_whitening(name, fn)


def _to_standard(name: str, fn: Any, value: Tensor) -> Tensor:
    base = _unwrap(fn)
    if isinstance(base, dist.Normal):
        return (value - base.loc) / base.scale
    if isinstance(base, dist.MultivariateNormal):
        gap = (value - base.loc)[..., None]
        return torch.linalg.solve_triangular(base.scale_tril, gap, upper=False)[..., 0]
    if isinstance(base, dist.TransformedDistribution):
        for transform in reversed(base.transforms):
            value = transform.inv(value)
        return _to_standard(name, base.base_dist, value)
    if isinstance(base, dist.Uniform):
        return torch.special.ndtri((value - base.low) / (base.high - base.low))
    raise _no_whitening(name, fn)


def _no_whitening(name: str, fn: Any) -> InputError:
    return InputError(
        "whitening needs Normal, Uniform or transformed Normal latents, "
        f"but '{name}' is {_describe(fn)}; fix() it first"
    )


def _gaussian_scale(name: str, site: Site) -> Tensor:
    base = _unwrap(site["fn"])
    if isinstance(base, dist.Normal):
        return base.scale
    if isinstance(base, dist.MultivariateNormal):
        return base.scale_tril
    if _is_frozen(site):
        raise InputError(
            f"least squares needs Gaussian sites, but the fixed '{name}' is {_describe(base)} and depends on latents; "
            "fix() what it depends on"
        )
    raise InputError(f"least squares needs Gaussian sites, but '{name}' is {_describe(base)}; fix() it first")


def _masked(site: Site, residual: Tensor) -> Tensor:
    """Zero the masked residuals and apply the site's scale, inside wrappers and out."""
    masks, fn = [site["mask"]], site["fn"]
    while isinstance(fn, WRAPPERS):
        masks += [fn._mask] if isinstance(fn, MaskedDistribution) else []
        fn = fn.base_dist
    for mask in masks:
        if mask is None:
            continue
        mask = torch.as_tensor(mask)
        extra = residual.dim() - max(mask.dim(), residual.dim() - len(site["fn"].event_shape))
        residual = torch.where(mask.reshape(mask.shape + (1,) * extra), residual, 0.0)
    return residual * math.sqrt(site["scale"])


def residuals(model: Model, latents: Latents, evidence: Any) -> dict[str, Tensor]:
    """Whitened residuals of every site, (value - mean) / standard deviation; none of a frozen site
    that does not depend on the latents.

    Half their squared sum is -log_joint up to a constant. Raises InputError by name for a site
    that is not Gaussian or whose scale depends on the latents (its log-determinant would be lost)."""
    latents = {n: v.detach().clone().requires_grad_(v.is_floating_point()) for n, v in latents.items()}
    sites = _sites(model, evidence, _Given(latents))
    sites = {n: s for n, s in sites.items() if not _is_frozen(s) or _site_log_prob(n, s).requires_grad}
    for name, site in sites.items():
        _refuse_latent_scale(name, _gaussian_scale(name, site).requires_grad)
    return {n: _masked(s, _to_standard(n, s["fn"], s["value"])).detach() for n, s in sites.items()}


def _refuse_latent_scale(name: str, depends: bool) -> None:
    if depends:
        raise InputError(
            f"least squares needs scales that do not depend on latents, but the scale of '{name}' does; "
            "fix() what it depends on"
        )


@dataclass(frozen=True)
class Bound:
    """A model with its evidence as a density of standard normal numbers x (*batch, size).

        z = T(x),   log p(x | y) = log N(x; 0, I) + log p(y | T(x)) + const

    Every latent is whitened by its own prior given its parents, so x is dimensionless. y holds the
    frozen sites beside the observed ones; `settled` names those whose density no x changes."""

    model: Model
    evidence: Any
    shapes: dict[str, torch.Size]
    pads: dict[str, int]
    settled: frozenset[str] = frozenset()

    @property
    def size(self) -> int:
        """Number of scalars in x."""
        return sum(shape.numel() for shape in self.shapes.values())

    def _numbers(self, x: Tensor) -> dict[str, Tensor]:
        parts = x.split([shape.numel() for shape in self.shapes.values()], -1)
        shapes = {n: x.shape[:-1] + self._padding(n, x.dim() > 1) + s for n, s in self.shapes.items()}
        return {n: p.reshape(shape) for (n, shape), p in zip(shapes.items(), parts, strict=True)}

    def _padding(self, name: str, batched: bool) -> torch.Size:
        """Plate dimensions of size one that set a batched global latent left of all plates."""
        return torch.Size((1,) * self.pads[name] if batched else ())

    def _run(self, x: Tensor) -> dict[str, Site]:
        return _sites(self.model, self.evidence, _Whitened(self._numbers(x)))

    def _compared(self, x: Tensor) -> dict[str, Site]:
        """The sites that have residuals: observed, or frozen below some latent."""
        return {n: s for n, s in self._run(x).items() if s["is_observed"] and n not in self.settled}

    def _prior_points(self, num: int) -> Iterator[Tensor]:
        """The same few points for every check, with gradients."""
        generator = torch.Generator().manual_seed(0)
        for _ in range(num):
            yield torch.randn(self.size, generator=generator, dtype=torch.float64).requires_grad_()

    def latents(self, x: Tensor) -> Latents:
        """T(x): whitened numbers to latents, {site: (*batch, *event)}."""
        return {n: s["value"] for n, s in self._run(x).items() if n in self.shapes}

    def whiten(self, latents: Latents) -> Tensor:
        """T^-1: latents to whitened numbers, (*batch, size)."""
        sites = _sites(self.model, self.evidence, _Given({n: latents[n] for n in self.shapes}))
        parts = []
        for name, shape in self.shapes.items():
            part = _to_standard(name, sites[name]["fn"], sites[name]["value"])
            batch = part.shape[: max(0, part.dim() - len(shape) - self.pads[name])]
            parts.append(part.reshape(*batch, -1))
        return torch.cat(parts, -1)

    def log_density(self, x: Tensor) -> Tensor:
        """log N(x; 0, I) + log p(y | T(x)), (*batch): log_joint plus the log Jacobian of T."""
        sites = self._run(x)
        plates = _plate_dims(sites)
        likelihood = {n: _sum_plates(_site_log_prob(n, s), plates) for n, s in sites.items() if s["is_observed"]}
        return -0.5 * (x.square() + math.log(2 * math.pi)).sum(-1) + total(likelihood)

    def residuals(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Prior residuals x (size) and whitened residuals of observed and frozen sites (M), x unbatched."""
        parts = [_masked(s, _to_standard(n, s["fn"], s["value"])).reshape(-1) for n, s in self._compared(x).items()]
        return x, torch.cat(parts) if parts else x.new_zeros(0)

    def check_residuals(self) -> None:
        """Raise InputError by name where observed or frozen sites are not Gaussian or their scale depends
        on the latents: by dependency, and by change between points for what gradients cannot see."""
        scales: dict[str, Tensor] = {}
        for x in self._prior_points(4):
            for name, site in self._compared(x).items():
                scale = _gaussian_scale(name, site)
                moved = name in scales and not torch.equal(scale, scales[name])
                _refuse_latent_scale(name, scale.requires_grad or moved)
                scales[name] = scale.detach()


def _refuse_weight(name: str, site: Site) -> None:
    fn, masked = site["fn"], site["mask"] is not None
    while isinstance(fn, WRAPPERS):
        masked, fn = masked or isinstance(fn, MaskedDistribution), fn.base_dist
    if masked or not bool((torch.as_tensor(site["scale"]) == 1).all()):
        raise InputError(
            f"whitening needs latents with their whole density, but '{name}' is under a "
            f"{'mask' if masked else 'scale'} (poutine or a subsampled plate); take it off or fix() the site"
        )


def _settled(bound: Bound, frozen: set[str]) -> frozenset[str]:
    """Those frozen sites whose density depends on no latent: by dependency and by change, as above."""
    still, seen = set(frozen), dict[str, Tensor]()
    for x in bound._prior_points(4 if frozen else 0):
        sites = bound._run(x)
        for name in sorted(still):
            log_prob = _log_prob(sites[name])
            if log_prob.requires_grad or not torch.equal(log_prob, seen.setdefault(name, log_prob)):
                still.remove(name)
    return frozenset(still)


def bind(model: Model, evidence: Any) -> Bound:
    """Bind a model to its evidence as a flat whitened density.

    Raises InputError by name for a latent that no map of normal numbers reaches, and for one under
    a scale or a mask: its density is then not that of the numbers."""
    with quiet_doubles(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        sites = _sample_sites(model, evidence)
    shapes, pads, plate_dims = {}, {}, _plate_dims(sites)
    for name, site in sites.items():
        if not site["is_observed"]:
            _to_standard(name, site["fn"], site["value"])
            _refuse_weight(name, site)
            shapes[name] = site["value"].shape
            pads[name] = plate_dims - (site["value"].dim() - site["fn"].event_dim)
    bound = Bound(model, evidence, shapes, pads)
    return replace(bound, settled=_settled(bound, {name for name, site in sites.items() if _is_frozen(site)}))
