"""Whiten a Pyro program: latents as standard normal numbers, observations in standard deviations.

Each latent is a map of standard normal numbers given its parents, taken site by site as the program runs; each
Gaussian observation, and each Gaussian site that fix() froze below a latent, leaves a residual:

    z_i = T_i(x_i; parents),   x_i ~ N(0, I)
          loc + L x_i                     Normal, MultivariateNormal
          low + (high - low) Phi(x_i)     Uniform
          f(T(x_i))                       TransformedDistribution: its transforms f after the map T of its base
          from_standard(x_i)              a distribution that brings its own map (OwnMap)

    r_j = L_j^-1 (y_j - loc_j)

L is the standard deviation, or the Cholesky factor of the covariance. Where no L_j depends on a latent,
|x|^2 / 2 + |r|^2 / 2 = -log p(x, y) + const: a problem of least squares. `bind` gives the flat density of x
that engines run on, `residuals` the residual of every site at given latents.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import torch
from pyro.distributions import ExpandedDistribution, MaskedDistribution
from pyro.poutine.messenger import Messenger
from pyro.poutine.util import site_is_subsample
from torch import Tensor
from torch import distributions as dist

from models.program import (
    Given,
    InputError,
    Latents,
    Model,
    Site,
    bare_log_prob,
    is_frozen,
    num_plate_dims,
    quiet_doubles,
    sample_sites,
    site_log_prob,
    sites_under,
    sum_plates,
    total,
)


class _Whitened(Messenger):
    """Give latent sites their values as maps of standard normal numbers."""

    def __init__(self, numbers: dict[str, Tensor]) -> None:
        super().__init__()
        self.numbers = numbers

    def _pyro_sample(self, msg: Any) -> None:
        if not msg["is_observed"] and not site_is_subsample(msg):
            number = self.numbers[msg["name"]]
            msg["value"], msg["done"] = _from_standard(msg["name"], msg["fn"], number), True


@runtime_checkable
class OwnMap(Protocol):
    """A distribution that is the image of standard normal numbers of its own shape, and the way back."""

    def from_standard(self, x: Tensor) -> Tensor: ...

    def to_standard(self, value: Tensor) -> Tensor: ...


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
    if isinstance(base, OwnMap):
        return base.from_standard(number)
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
    if isinstance(base, OwnMap):
        return base.to_standard(value)
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
    if is_frozen(site):
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
    sites = sites_under(model, evidence, Given(latents))
    sites = {n: s for n, s in sites.items() if not is_frozen(s) or site_log_prob(n, s).requires_grad}
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
        return sites_under(self.model, self.evidence, _Whitened(self._numbers(x)))

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
        sites = sites_under(self.model, self.evidence, Given({n: latents[n] for n in self.shapes}))
        parts = []
        for name, shape in self.shapes.items():
            part = _to_standard(name, sites[name]["fn"], sites[name]["value"])
            batch = part.shape[: max(0, part.dim() - len(shape) - self.pads[name])]
            parts.append(part.reshape(*batch, -1))
        return torch.cat(parts, -1)

    def log_likelihoods(self, x: Tensor) -> dict[str, Tensor]:
        """Log density of every observed or frozen site at T(x), {site: (*batch)}."""
        sites = self._run(x)
        plates = num_plate_dims(sites)
        return {n: sum_plates(site_log_prob(n, s), plates) for n, s in sites.items() if s["is_observed"]}

    def log_density(self, x: Tensor) -> Tensor:
        """log N(x; 0, I) + log p(y | T(x)), (*batch): log_joint plus the log Jacobian of T."""
        return -0.5 * (x.square() + math.log(2 * math.pi)).sum(-1) + total(self.log_likelihoods(x))

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
            log_prob = bare_log_prob(sites[name])
            if log_prob.requires_grad or not torch.equal(log_prob, seen.setdefault(name, log_prob)):
                still.remove(name)
    return frozenset(still)


def bind(model: Model, evidence: Any) -> Bound:
    """Bind a model to its evidence as a flat whitened density.

    Raises InputError by name for a latent that no map of normal numbers reaches, and for one under
    a scale or a mask: its density is then not that of the numbers."""
    with quiet_doubles(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        sites = sample_sites(model, evidence)
    shapes, pads, plate_dims = {}, {}, num_plate_dims(sites)
    for name, site in sites.items():
        if not site["is_observed"]:
            _to_standard(name, site["fn"], site["value"])
            _refuse_weight(name, site)
            shapes[name] = site["value"].shape
            pads[name] = plate_dims - (site["value"].dim() - site["fn"].event_dim)
    bound = Bound(model, evidence, shapes, pads)
    return replace(bound, settled=_settled(bound, {name for name, site in sites.items() if is_frozen(site)}))
