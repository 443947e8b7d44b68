"""The adapter: what training adds to a checkpoint, small, exact and removable. Training writes what
it gives.
"""

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from clod_adapter._support.arrays import tensor_of
from clod_adapter._support.text import package_version
from clod_adapter.config import CLASSIC, AttenuationConfig, ScreenFilter, require
from clod_adapter.equation.attenuation import SIGMA_MAX
from clod_adapter.equation.units import in_world_units
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians, describe_dial, with_near
from clod_adapter.origin import NOWHERE, Origin
from clod_adapter.quality_table import QualityTable

HALF_ERROR = 2e-3  # the rounding that a difference may suffer, as a share of the largest
ATTRIBUTES = ("means", "quats", "log_scales", "opacity_logits", "sh0", "shN")
DIAL = ("sigma_d", "growth_d")


@dataclass(frozen=True)
class Adapter:
    """A learned dial and the light update of the other attributes; applied to its base it gives the
    result bit for bit.

    Attributes:
        sigma_d: ``[N]`` float32, finite.
        attenuation: how sigma_d is to be read.
        updates: of what changed, in its shape: differences from the base (float16), or new values
            (float32).
        base_fingerprint: SHA-256 of the checkpoint file it was trained on, hex.
        config: the training config, JSON-able, for the record.
        version: of the package that made it; it stands in the header of the PLY, which is so the
            same again.
        quality_table: what the result's dial values keep, cost and take, where that was measured;
            in the header too.
        origin: ``[3]`` what the base's means were relative to, world units (``Checkpoint.origin``).
        screen_filter: that it was trained with, and the result is drawn with.
        growth_d: ``[N]`` float32, finite, exponents of the growth of the scales. None for no
            growth.
        added: the ATTRIBUTES of far Gaussians, float32, which follow the base's. None without; else
            updates are empty.
        notes: of reading its file: settings that were ignored or filled in.

    Raises:
        ClodError: a tensor has the wrong type or shape, sigma_d or growth_d is not finite, or
            version is no plain text.
    """

    sigma_d: Tensor
    attenuation: AttenuationConfig
    updates: dict[str, Tensor]
    base_fingerprint: str
    config: dict[str, Any]
    version: str = field(default_factory=package_version)
    quality_table: QualityTable | None = None
    origin: Origin = NOWHERE
    screen_filter: ScreenFilter = CLASSIC
    growth_d: Tensor | None = None
    added: dict[str, Tensor] = field(default_factory=dict)
    notes: tuple[str, ...] = field(default=(), compare=False)

    def __post_init__(self) -> None:
        for name, column in dial_tensors(self).items():
            object.__setattr__(self, name, tensor_of(column))
        for name in ("updates", "added"):
            tensors = {key: tensor_of(value) for key, value in getattr(self, name).items()}
            object.__setattr__(self, name, tensors)
        count = self.sigma_d.numel()
        for name, column in dial_tensors(self).items():
            sound = column.shape == (count,) and column.dtype == torch.float32
            require(sound, f"Adapter.{name}", kind_of(column), f"float32 [{count}]")
            if not column.isfinite().all():
                raise ClodError(
                    f"Adapter.{name} holds a value that is not finite; the training has diverged"
                )
        plain = self.version.isascii() and self.version.isprintable()
        require(plain, "Adapter.version", repr(self.version), "printable ASCII")
        for name, update in self.updates.items():
            if name not in ATTRIBUTES:
                known = ", ".join(ATTRIBUTES)
                raise ClodError(f"Adapter.updates has {name!r}, it may have {known}")
            floats = update.dtype in (torch.float16, torch.float32)
            sound = floats and update.shape[:1] == self.sigma_d.shape
            what = f"float16 or float32 of {count} rows"
            require(sound, f"Adapter.updates[{name!r}]", kind_of(update), what)
        if self.added:
            attributes: Any = self.added
            far = Gaussians(**attributes)  # checks names and shapes
            fits = not self.updates and len(far) < count
            rows = f"of {len(far)} of {count} rows"
            require(fits, "Adapter.added", rows, "of fewer, without updates")

    def __repr__(self) -> str:
        updates = ", ".join(self.updates) or "nothing"
        return (
            f"Adapter({len(self.sigma_d):,} Gaussians, {describe_dial(self)}, updates of {updates})"
        )

    @property
    def base_count(self) -> int:
        """The number of Gaussians of the base."""
        return len(self.sigma_d) - len(self.added.get("means", ()))

    def apply(self, base: Gaussians, fingerprint: str | None = None) -> Gaussians:
        """The adapted Gaussians: the base plus the differences in float32, and the dial.

        Args:
            base: the Gaussians of the checkpoint it was trained on, as
                ``load(path, origin=adapter.origin)`` reads it.
            fingerprint: that checkpoint file's SHA-256; when given it must be the adapter's.

        Raises:
            ClodError: a different base was given.
        """
        if fingerprint is not None and fingerprint != self.base_fingerprint:
            raise _other_base(f"SHA-256 {fingerprint[:12]}", self.base_fingerprint[:12])
        if len(base) != self.base_count:
            raise _other_base(f"{len(base)} Gaussians", self.base_count)
        plain = base.replace(sigma_d=None, growth_d=None, attenuation=None)
        device = base.means.device
        changes: Any = {name: column.to(device) for name, column in dial_tensors(self).items()}
        changes |= {"attenuation": self.attenuation, "screen_filter": self.screen_filter}
        if self.added:
            attributes: Any = {name: values.to(device) for name, values in self.added.items()}
            for name in dial_tensors(self):
                changes[name] = changes[name][len(base) :]
            return with_near(plain, Gaussians(**attributes, **changes))
        for name, update in self.updates.items():
            old = getattr(base, name)
            if update.shape != old.shape:
                raise _other_base(f"{name} {kind_of(old)}", kind_of(update))
            update = update.to(device)
            # old, not old + 0, where nothing changed: that would turn -0 into 0
            if update.dtype == torch.float16:
                update = torch.where(update == 0, old, old + update.float())
            changes[name] = update
        return plain.replace(**changes)


def _other_base(given: str, expected: object) -> ClodError:
    return ClodError(
        f"a different base was given: it has {given}, the adapter {expected}; give the checkpoint"
        " it was trained on"
    )


def dial_tensors(owner: Adapter | Gaussians) -> dict[str, Tensor]:
    """The columns of DIAL that it has, by name."""
    columns = {name: getattr(owner, name) for name in DIAL}
    return {name: column for name, column in columns.items() if column is not None}


def extract(
    base: Gaussians,
    adapted: Gaussians,
    *,
    fingerprint: str,
    config: dict[str, Any],
    origin: Origin = NOWHERE,
) -> Adapter:
    """The adapter that makes ``adapted`` of ``base``, with differences rounded to float16.

    sigma_d is taken in world units. Attributes with identical values are left out. Where the
    differences do not fit float16 (one overflows, all are tiny, or an infinite logit became finite)
    the attribute is kept as its float32 values. A dial that ``base`` may already have plays no
    part.

    Raises:
        ClodError: ``adapted`` has no dial, is not finite, or is not the same Gaussians as ``base``.

    Example:
        >>> base, model = clod.load("base.ply"), clod.load("model.ply")
        >>> sha256 = base.fingerprint
        >>> adapter = clod.extract(base.gaussians, model.gaussians, fingerprint=sha256, config={})
        >>> clod.save_adapter("model.safetensors", adapter)
    """
    adapted = in_world_units(adapted)
    if adapted.attenuation is None:
        raise ClodError(
            "the adapted Gaussians have no sigma_d, and so no dial; give the result of adapt"
        )
    added = dict[str, Tensor]()
    near = adapted
    if adapted.near is not None and base.near is None:
        near = adapted.select(adapted.near)
        far = adapted.select(~adapted.near)
        added = {name: _stored(getattr(far, name)) for name in ATTRIBUTES}
    columns: Any = {name: _stored(column) for name, column in dial_tensors(adapted).items()}
    return Adapter(
        **columns,
        attenuation=adapted.attenuation,
        updates=_updates(base, near),
        base_fingerprint=fingerprint,
        config=dict(config),
        origin=origin,
        screen_filter=adapted.screen_filter,
        added=added,
    )


def with_dial(
    gaussians: Gaussians,
    sigma_d: Tensor | None = None,
    attenuation: AttenuationConfig | None = None,
    growth_d: Tensor | None = None,
) -> Gaussians:
    """The Gaussians with this dial alone, by the default settings; without ``sigma_d`` one that
    changes nothing.

    That is SIGMA_MAX, whose gradient is 0: for a dial that a training loop learns, see ``attach``.

    Args:
        sigma_d: ``[N]`` world units; growth_d: ``[N]`` exponents, or None for no growth.

    Example:
        >>> base = clod.load("base.ply").gaussians
        >>> model = clod.with_dial(base, torch.full([len(base)], 20.0))
    """
    if sigma_d is None:
        sigma_d = torch.full_like(gaussians.opacity_logits, SIGMA_MAX, dtype=torch.float32)
    return gaussians.replace(
        sigma_d=sigma_d, growth_d=growth_d, attenuation=attenuation or AttenuationConfig()
    )


def detach(gaussians: Gaussians) -> Gaussians:
    """The Gaussians without their dial, as s = 0 shows them: the near ones, if others take over
    from these.

    Example:
        >>> plain = clod.detach(clod.load("model.ply").gaussians)
    """
    if gaussians.near is not None:
        gaussians = gaussians.select(gaussians.near)
    return gaussians.replace(sigma_d=None, growth_d=None, attenuation=None)


def _stored(values: Tensor) -> Tensor:
    return values.detach().float().cpu().clone()


def _updates(base: Gaussians, adapted: Gaussians) -> dict[str, Tensor]:
    """The update of each attribute that changed."""
    updates = dict[str, Tensor]()
    for name in ATTRIBUTES:
        old = getattr(base, name).detach().float()
        new = getattr(adapted, name).detach().float()
        if old.shape != new.shape:
            raise ClodError(
                f"{name} is {kind_of(new)}, in the base {kind_of(old)}; give the Gaussians that"
                " were adapted"
            )
        if not torch.equal(old, new):
            updates[name] = _update(name, old, new).cpu()
    return updates


def _update(name: str, old: Tensor, new: Tensor) -> Tensor:
    same = old == new  # inf - inf would be NaN
    if not (new.isfinite() | same).all():
        raise ClodError(f"{name} holds a new value that is not finite; the training has diverged")
    exact = torch.where(same, 0.0, new - old)
    delta = exact.half()
    # float16 has 11 bits, but fewer below 6e-5: in a scene of small numbers that is all there is to
    # a difference.
    error = (delta.float() - exact).abs().amax()
    largest = exact.abs().amax()
    return delta if delta.isfinite().all() and error <= HALF_ERROR * largest else new.clone()


def kind_of(tensor: Tensor) -> str:
    """``float32 [100, 3]``."""
    return f"{str(tensor.dtype).removeprefix('torch.')} {list(tensor.shape)}"
