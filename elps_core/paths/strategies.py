"""Which ways of making a path exist: (s, t) with s light vertices and t eye vertices [thesis 4.7].

Path tracing, light tracing and bidirectional path tracing are three selections of strategies over the
same walks, connections and weights. Light that the sensor sees directly is always (0, 2): what other
strategies would add there is noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from elps_core.errors import SettingsRejected
from elps_core.settings import RenderSettings


@dataclass(frozen=True)
class Strategies:
    """The strategies that exist, and so enter each other's weights, and those that are shown."""

    emission: bool
    """s = 0: eye paths that meet an emitter after a bounce."""
    next_event: bool
    """s = 1: eye vertices joined to a fresh light point."""
    joins: bool
    """s, t >= 2: eye vertices joined to light vertices."""
    sensor: bool
    """t = 1: light vertices joined to the sensor."""
    aperture: bool
    """t = 0: light paths that meet the aperture."""
    shown: frozenset[tuple[int, int]] | None = None
    """The (s, t) that reach the image; None for all. The weights do not ask."""
    weighted: bool = True
    """Whether contributions are weighted; without, each strategy is the whole of its paths' light."""
    direct: bool = True
    """Whether light that the sensor sees directly is shown."""
    rivals: bool = False
    """Whether light paths are shown so that the mean of their squares is that of eye paths: of those of them that light
    paths find the more easily. Nothing else is shown then."""

    @property
    def eye_paths(self) -> bool:
        """Whether eye paths go on after the first vertex."""
        return (self.emission or self.next_event or self.joins) and not self.rivals

    @property
    def both(self) -> bool:
        """Whether paths from either end compete for the same light."""
        return self.joins or (self.sensor and self.emission and self.next_event)

    @property
    def light_paths(self) -> bool:
        """Whether light paths are traced."""
        return self.joins or self.sensor or self.aperture


def path(*, next_event: bool = True) -> Strategies:
    """Path tracing from the sensor [thesis 4.7.1]."""
    return Strategies(emission=True, next_event=next_event, joins=False, sensor=False, aperture=False)


def light(*, connect: bool = True, aperture: bool = False) -> Strategies:
    """Path tracing from the lights; ``aperture``: the sensor has one of finite size.

    Raises:
        SettingsRejected: nothing can reach the sensor.
    """
    if not (connect or aperture):
        raise SettingsRejected("no light path meets a pinhole: use a 'thinlens' sensor, or set light.connect=true")
    return Strategies(emission=False, next_event=False, joins=False, sensor=connect, aperture=aperture)


def bdpt(*, aperture: bool = False) -> Strategies:
    """All strategies [thesis 4.7.3]."""
    return Strategies(emission=True, next_event=True, joins=True, sensor=True, aperture=aperture)


def chosen(settings: RenderSettings, *, aperture: bool) -> Strategies:
    """The strategies of a render; ``aperture``: the sensor has one of finite size.

    Raises:
        SettingsRejected: as :func:`light`.
    """
    if settings.integrator == "path":
        return path(next_event=settings.path.next_event)
    if settings.integrator == "pssmlt" and settings.pssmlt.over == "path":
        return path()
    if settings.integrator == "pssmlt" and settings.pssmlt.over == "unjoined":
        return replace(bdpt(aperture=aperture), joins=False)
    if settings.integrator == "light":
        return light(connect=settings.light.connect, aperture=aperture)
    every = bdpt(aperture=aperture)
    if settings.integrator == "bdpt":
        joins, shown, weighted = settings.bdpt.joins, settings.bdpt.pairs(), settings.bdpt.weighted
        return replace(every, joins=joins, shown=shown, weighted=weighted)
    return every
