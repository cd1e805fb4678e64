"""The group `baselines` of the experiment's config: a group for each method that has settings, as it declares them."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from playslot_rl.config.methods import METHODS


@dataclass(frozen=True)
class BaselinesConfig:
    """Sizes and schedules, one group a method: `config.baselines.lapo`. See `baselines`."""

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """The settings of a method."""

    def __reduce__(self) -> tuple[Any, ...]:
        return _again, ({field.name: getattr(self, field.name) for field in dataclasses.fields(self)},)

    @classmethod
    def whole(cls) -> type[BaselinesConfig]:
        return _whole()


def baselines(**changed: Any) -> BaselinesConfig:
    """The settings of all methods, by default but for some methods."""
    return _whole()(**changed)


def baselines_of(config: Any) -> dict[str, Any]:
    """The settings of each method that an experiment's config holds, by its name."""
    return {field.name: getattr(config.baselines, field.name) for field in dataclasses.fields(config.baselines)}


def known_methods(values: Mapping[str, Any]) -> dict[str, Any]:
    """A stored config without the settings of methods that no package brings any more."""
    own = values.get("baselines")
    if not isinstance(own, dict):
        return dict(values)
    names = {field.name for field in dataclasses.fields(_whole())}
    return {**values, "baselines": {name: group for name, group in own.items() if name in names}}


@functools.cache
def _whole() -> type[BaselinesConfig]:
    groups = {name: method.config for name, method in METHODS.items() if method.config is not None}
    fields = [(name, cls, dataclasses.field(default_factory=cls)) for name, cls in groups.items()]
    return dataclasses.make_dataclass("BaselinesConfig", fields, bases=(BaselinesConfig,), frozen=True, module=__name__)


def _again(values: dict[str, Any]) -> BaselinesConfig:
    return baselines(**values)
