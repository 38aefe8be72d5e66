"""Path, light and bidirectional path tracing: selections of strategies over the same two walks [thesis 4.7].

A pass traces one eye and one light path per lane, in two kernels: the light kernel walks from the
emitters, joins each vertex to the sensor (t = 1) and stores it; the eye kernel walks from the
sensor, collects emission (s = 0), estimates direct light (s = 1) and joins each vertex to all that
the light path of its lane has stored (s >= 2). What the selection leaves out is not traced.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, TypeAlias

import drjit as dr
import mitsuba as mi

from elps_core.paths.connect import Connector
from elps_core.paths.mis import Heuristic, Partial
from elps_core.paths.roulette import RouletteRule
from elps_core.paths.scattering import Materials
from elps_core.paths.strategies import Strategies
from elps_core.paths.strategies import bdpt as all_strategies
from elps_core.paths.stream import Stream
from elps_core.paths.turns import Turns
from elps_core.paths.vertex import Vertex, VertexStore
from elps_core.paths.walk import Walk, random_walk
from elps_core.sampling.direction import Directions
from elps_core.sampling.lights import NOWHERE, RegionLights
from elps_core.sampling.start import Start, StartDensity
from elps_core.scene.sensors import Camera, PrimaryRay, SensorSample
from elps_core.settings import HeuristicKind

Splat: TypeAlias = "Callable[[mi.Point2f, mi.Spectrum, mi.Spectrum, mi.UInt32, mi.Bool], None]"
"""Adds the contribution of a sample's light path at a film position, pixels relative to the crop window."""
Deposit: TypeAlias = "Callable[[mi.UInt32, mi.Spectrum, mi.Spectrum, mi.Bool], None]"
"""Adds a contribution to the adjoint image, at the cell where the light vertex lies."""


class Worth(Protocol):
    """What a unit of luminance is worth, for roulette by context."""

    gain: float
    """Of light paths, whose importance counts what pixels are worth."""

    def __call__(self, position: mi.Point2f) -> mi.Float:
        """At a film position, pixels relative to the crop window."""
        ...


@dataclass
class _Eye:
    """What the eye walk carries besides its own state."""

    radiance: mi.Spectrum
    region: mi.UInt32  # By which a light was chosen at the last vertex
    sample: mi.UInt32


@dataclass
class _Light:
    """What the light walk carries besides its own state."""

    stored: mi.UInt32
    cell: mi.UInt32  # Where the path started
    weight: mi.Spectrum  # Of the wavelengths
    sample: mi.UInt32


@dataclass(frozen=True)
class _Samples:
    """The samples of a pass, and how lanes share them."""

    position: mi.Point2f
    u_wavelength: mi.Float
    count: int
    lanes: int
    turns: Turns

    @property
    def single(self) -> bool:
        """Whether each lane has one sample."""
        return self.count == self.lanes

    @staticmethod
    def of(position: mi.Point2f, turns: int, stream: Stream) -> _Samples:
        count = dr.width(position)
        lanes = -(-count // turns)
        u_wavelength = stream.wavelengths(count, turns) if mi.is_spectral else mi.Float(0.5)
        shared = Turns(count, lanes)
        if turns > 1:
            # The lanes' first samples, too: an eye walk is one kernel, whether a light walk came before or not.
            dr.eval(position, u_wavelength, stream, shared.first)
        return _Samples(position, u_wavelength, count, lanes, shared)

    def at(self, sample: mi.UInt32, active: mi.Bool) -> tuple[mi.Point2f, mi.Float]:
        """Film position of a sample, and the number that chooses its wavelengths."""
        if self.single:
            return self.position, self.u_wavelength
        u_wavelength = dr.gather(mi.Float, self.u_wavelength, sample, active) if mi.is_spectral else self.u_wavelength
        return dr.gather(mi.Point2f, self.position, sample, active), u_wavelength

    def going(self, state: _Eye | _Light) -> mi.Bool:
        """Which lanes have a sample to finish."""
        return self.turns.left(state.sample)


class Bdpt:
    """The paths of one scene, sensor, start density and selection of strategies.

    ``max_depth`` counts segments as Mitsuba does; ``thinning`` is the number of eye paths for one light path: weights
    count with it, and :meth:`trace` is told which eye paths have one; ``deposit``, where given to :meth:`trace`,
    receives every contribution with the cell of its light vertex, so that the same code that
    renders measures the adjoint image.
    """

    def __init__(
        self,
        scene: mi.Scene,
        camera: Camera,
        lights: StartDensity,
        *,
        max_depth: int,
        roulette: RouletteRule,
        strategies: Strategies | None = None,
        heuristic: HeuristicKind = "power",
        directions: Directions | None = None,
        worth: Worth | None = None,
        thinning: int = 1,
        region_lights: RegionLights | None = None,
        hides: bool = False,
    ) -> None:
        self.scene = scene
        self.camera = camera
        self.lights = lights
        # Without a surface there is only what comes straight from the environment.
        self.max_depth = max_depth = max_depth if scene.shapes() else 1
        self.roulette = roulette
        self.strategies = strategies or all_strategies(aperture=camera.has_aperture)
        self.heuristic = Heuristic(heuristic, max_depth + 1, self.strategies.joins)
        self.directions = directions or Directions(Materials(scene))
        self.worth = worth
        self.thinning = thinning
        # Data, not code: 4 and 16 eye paths for a light path are one kernel.
        self._fraction = 1.0 if thinning == 1 else dr.opaque(mi.Float, 1.0 / thinning)
        self.region_lights = region_lights
        self.hides = hides
        """Whether the camera sees no emitters: only where no light paths reach it."""
        self.connector = Connector(
            scene, camera, lights, self.directions, self.strategies, self.heuristic, self._fraction, region_lights
        )
        self.slots = max(0, max_depth - 2) if self.strategies.joins else 0
        """Light vertices stored per lane: deeper ones can only be joined to the sensor."""

    def selecting(self, strategies: Strategies, max_depth: int | None = None) -> Bdpt:
        """The same paths by another selection of strategies, and up to another length."""
        return Bdpt(
            self.scene,
            self.camera,
            self.lights,
            max_depth=max_depth or self.max_depth,
            roulette=self.roulette,
            strategies=strategies,
            heuristic=self.heuristic.kind,
            directions=self.directions,
            worth=self.worth,
            thinning=self.thinning,
            region_lights=self.region_lights,
            hides=self.hides,
        )

    def trace(
        self,
        position: mi.Point2f,
        streams: tuple[Stream, Stream],
        splat: Splat,
        deposit: Deposit | None = None,
        between: Callable[[], None] = lambda: None,
        light_scale: float | None = 1.0,
        turns: int = 1,
    ) -> tuple[mi.Spectrum, mi.Spectrum]:
        """One pass over all samples. Returns the radiance of the eye paths through ``position``.

        ``position`` holds film positions in pixels relative to the crop window, one per sample, drawn
        uniformly over the film; ``streams`` the random numbers of the eye and of the light paths, a
        lane for every ``turns`` samples. A lane begins its next path as soon as one has ended: lanes
        run in packets, and would else wait for the longest path of each.
        Contributions of light paths go to ``splat``, each per light path over the whole film.
        ``light_scale`` is the number of eye paths for one light path as they are traced, None for eye paths alone.
        ``between`` is called when the light kernel has run and the eye kernel is about to be built.
        """
        eye_stream, light_stream = streams
        samples = _Samples.of(position, turns, eye_stream)
        connector, stored_depth = self.connector, 0 if light_scale is None else self.slots
        scale = dr.opaque(mi.Float, light_scale or 0.0)
        store = VertexStore(
            samples.count, stored_depth, tangents=connector.surfaces.bends_frames, ratios=self.heuristic.width
        )
        cells = mi.UInt32(0)
        if self.strategies.light_paths and self.max_depth >= 2 and light_scale is not None:
            cells = self._light_walk(light_stream, samples, store, splat, deposit)
        between()
        if self.strategies.rivals:
            return dr.zeros(mi.Spectrum), self.primary(position, None, samples.u_wavelength).ray.wavelengths

        def visit(walk: Walk, vertex: Vertex, eye: _Eye, active: mi.Bool) -> _Eye:
            emitted, hit_cell = connector.hit_emitter(walk, vertex, eye.region, active)
            if self.hides:
                emitted = dr.select(vertex.depth > 1, emitted, 0.0)
            if deposit:
                deposit(hit_cell, emitted, walk.ray.wavelengths, walk.active)
            radiance = eye.radiance + emitted
            if not self.strategies.next_event or self.max_depth == 1:
                return _Eye(radiance, eye.region, eye.sample)
            smooth = active & self.connector.surfaces.flags.smooth(vertex.si)
            direct = smooth & (vertex.depth < self.max_depth)
            region = connector.light_region(vertex.si, direct)
            lit, start = connector.connect_light(vertex, region, walk.stream, direct)
            if deposit:
                deposit(start.cell, lit, walk.ray.wavelengths, direct)
            radiance = radiance + lit
            if stored_depth == 0:
                return _Eye(radiance, region, eye.sample)

            count = dr.gather(mi.UInt32, store.count, eye.sample, smooth)
            cell = dr.gather(mi.UInt32, cells, eye.sample, smooth) if deposit else mi.UInt32(0)

            def join(slot: mi.UInt32, total: mi.Spectrum, more: mi.Bool) -> tuple[mi.UInt32, mi.Spectrum, mi.Bool]:
                light = store.read(slot, eye.sample, walk.ray.wavelengths, more)
                # Depths grow with the slot: what follows a vertex that is too deep is too deep.
                more = more & (vertex.depth + light.depth + 1 <= self.max_depth)
                joined = connector.connect_vertices(vertex, light, more) * scale
                if deposit:
                    deposit(cell, joined, walk.ray.wavelengths, more)
                return slot + 1, total + joined, more & (slot + 1 < count)

            start_state = (dr.zeros(mi.UInt32, samples.lanes), radiance, smooth & (count > 0))
            _, radiance, _ = dr.while_loop(start_state, lambda _s, _t, more: more, join, label="elps connect")
            return _Eye(radiance, region, eye.sample)

        found = [dr.empty(mi.Float, 0 if samples.single else samples.count) for _ in range(dr.size_v(mi.Spectrum))]

        def begin(sample: mi.UInt32, stream: Stream, active: mi.Bool) -> Walk:
            position, u_wavelength = samples.at(sample, active)
            stream = stream.at(sample, active)
            walk = self.eye_start(self.primary(position, stream, u_wavelength), stream)
            return self._past_emitters(walk) if self.hides else walk

        def renew(walk: Walk, eye: _Eye) -> tuple[Walk, _Eye]:
            ended = ~walk.active
            for k, channel in enumerate(found):
                dr.scatter(channel, eye.radiance[k], eye.sample, ended)
            sample, more = samples.turns.after(eye.sample, ended)
            fresh = _Eye(dr.zeros(mi.Spectrum), mi.UInt32(NOWHERE), sample)
            return walk.where(more, begin(sample, walk.stream, more)), dr.select(ended, fresh, eye)

        def pay(eye: _Eye, amount: mi.Spectrum) -> _Eye:
            return replace(eye, radiance=eye.radiance + amount)

        first, lanes = samples.turns.first, samples.lanes
        eye = random_walk(
            self.lights.emission.rays,
            begin(first, eye_stream, mi.Bool(True)),
            visit,
            _Eye(dr.zeros(mi.Spectrum, lanes), dr.full(mi.UInt32, NOWHERE, lanes), first),
            side="eye",
            max_depth=self.max_depth if self.strategies.eye_paths else 1,
            roulette=self.roulette,
            heuristic=self.heuristic,
            directions=self.directions,
            pay=pay,
            renew=None if samples.single else renew,
            going=None if samples.single else samples.going,
            label="elps eye walk",
        )
        dr.eval(found)
        wavelengths = self.primary(position, None, samples.u_wavelength).ray.wavelengths
        return eye.radiance if samples.single else mi.Spectrum(found), wavelengths

    def primary(self, position: mi.Point2f, stream: Stream | None, u_wavelength: mi.Float | None = None) -> PrimaryRay:
        """The ray through a film position.

        Takes the number for its wavelengths, unless given, and those for its aperture point, which is the middle
        without ``stream``.
        """
        if u_wavelength is None:
            u_wavelength = stream.next_1d() if stream and mi.is_spectral else mi.Float(0.5)
        aperture = stream.next_2d() if stream and self.camera.has_aperture else mi.Point2f(0.5)
        return self.camera.sample_ray(position, u_wavelength, aperture)

    def eye_start(self, primary: PrimaryRay, stream: Stream) -> Walk:
        """A walk at the sensor, its first ray chosen."""
        lanes = dr.width(primary.ray)
        pdf_aperture = self.camera.pdf_aperture if self.strategies.aperture else mi.Float(dr.inf)
        return Walk(
            ray=primary.ray,
            beta=mi.Spectrum(primary.weight),
            partial=self._full(self.heuristic.start(pdf_aperture, primary.cosine, primary.pdf, "eye"), lanes),
            eta=dr.ones(mi.Float, lanes),
            depth=dr.zeros(mi.UInt32, lanes),
            offset=primary.offset,
            parallel=dr.full(mi.Bool, self.camera.parallel, lanes),
            raised=dr.ones(mi.Float, lanes),
            worth=dr.ones(mi.Float, lanes) * (self.worth(primary.position) if self.worth else 1.0),
            stream=stream,
            active=dr.full(mi.Bool, True, lanes),
        )

    def _past_emitters(self, walk: Walk) -> Walk:
        """A walk whose first ray begins behind the emitters that it would meet first, as Mitsuba hides them."""

        def passes(ray: mi.Ray3f, offset: mi.Float, more: mi.Bool) -> tuple[mi.Ray3f, mi.Float, mi.Bool]:
            si = self.scene.ray_intersect(ray, more)
            more = more & si.is_valid() & si.shape.is_emitter()
            after = si.spawn_ray(ray.d)
            origin = dr.select(more, after.o, ray.o)
            offset = offset + dr.dot(origin - ray.o, ray.d)
            return mi.Ray3f(origin, ray.d, ray.time, ray.wavelengths), offset, more

        lanes = dr.width(walk.active)
        state = (mi.Ray3f(walk.ray), walk.offset + dr.zeros(mi.Float, lanes), mi.Bool(walk.active))
        ray, offset, _ = dr.while_loop(state, lambda *state: state[-1], passes, label="elps hidden emitters")
        return replace(walk, ray=ray, offset=offset)

    def light_start(self, start: Start, stream: Stream) -> Walk:
        """A walk at an emitter, its first ray chosen."""
        emission, point = self.lights.emission, start.point
        lanes = dr.width(start.pdf)
        ray = self.lights.first_ray(start, stream.next_2d(), mi.Bool(True))
        radiance, cosine = emission.radiance(point, ray.d, mi.Bool(True))
        delta, infinite, active = point.delta, point.infinite, mi.Bool(True)
        pdf = self.lights.pdf_direction(
            point.index, start.cell, point.si.p, ray.d, cosine, active, delta=delta, infinite=infinite
        )
        pdf_point = dr.select(point.delta, dr.inf, start.pdf)
        return Walk(
            ray=ray,
            beta=radiance * (cosine / (start.pdf * pdf)),
            partial=self._full(self.heuristic.start(pdf_point, cosine, pdf, "light", self._fraction), lanes),
            eta=dr.ones(mi.Float, lanes),
            depth=dr.zeros(mi.UInt32, lanes),
            offset=emission.gap(point, active) + dr.zeros(mi.Float, lanes),
            parallel=point.infinite & dr.full(mi.Bool, True, lanes),
            raised=dr.ones(mi.Float, lanes),
            worth=dr.ones(mi.Float, lanes) * (self.worth.gain if self.worth else 1.0),
            stream=stream,
            active=(pdf > 0.0) & (dr.max(radiance) > 0.0),
        )

    def _light_walk(
        self, stream: Stream, samples: _Samples, store: VertexStore, splat: Splat, deposit: Deposit | None
    ) -> mi.UInt32:
        """Walk from the lights; fills ``store`` and evaluates it. Returns each sample's start cell."""
        connector, lanes = self.connector, samples.lanes
        cells = dr.empty(mi.UInt32, samples.count if deposit else 0)

        def begin(sample: mi.UInt32, stream: Stream, active: mi.Bool) -> tuple[Walk, _Light]:
            # Both paths of a sample have its wavelengths.
            stream = stream.at(sample, active)
            position, u_wavelength = samples.at(sample, active)
            seen = self.primary(position, None, u_wavelength)
            wavelengths = seen.ray.wavelengths
            start = self.lights.sample(
                stream.next_2d(), stream.next_2d(even=False), wavelengths, active & dr.full(mi.Bool, True, lanes)
            )
            return self.light_start(start, stream), _Light(
                dr.zeros(mi.UInt32, lanes), mi.UInt32(start.cell), seen.weight, sample
            )

        def arrive(seen: mi.Spectrum, sample: SensorSample, walk: Walk, light: _Light, active: mi.Bool) -> None:
            seen, active = seen * light.weight, active & sample.valid
            splat(sample.position, seen, walk.ray.wavelengths, light.sample, active)
            if deposit:
                deposit(light.cell, seen, walk.ray.wavelengths, active)

        def visit(walk: Walk, vertex: Vertex, light: _Light, active: mi.Bool) -> _Light:
            if self.strategies.aperture:
                arrive(*connector.hit_aperture(walk, walk.active), walk, light, walk.active)
            smooth = active & self.connector.surfaces.flags.smooth(vertex.si)
            smooth = smooth & (vertex.depth < self.max_depth)
            vertex.partial = connector.first_light_vertex(vertex, light.cell, active)
            if self.strategies.sensor:
                arrive(*connector.connect_sensor(vertex, walk.stream, smooth), walk, light, smooth)
            if self.slots == 0:
                return light
            keep = smooth & (vertex.depth <= self.slots)
            store.write(light.stored, light.sample, vertex, keep)
            return replace(light, stored=light.stored + dr.select(keep, mi.UInt32(1), mi.UInt32(0)))

        def finish(light: _Light, ended: mi.Bool) -> None:
            dr.scatter(store.count, light.stored, light.sample, ended)
            if deposit:
                dr.scatter(cells, light.cell, light.sample, ended)

        def renew(walk: Walk, light: _Light) -> tuple[Walk, _Light]:
            ended = ~walk.active
            finish(light, ended)
            sample, more = samples.turns.after(light.sample, ended)
            fresh, state = begin(sample, walk.stream, more)
            return walk.where(more, fresh), dr.select(ended, state, light)

        walk, state = begin(samples.turns.first, stream, mi.Bool(True))
        light = random_walk(
            self.lights.emission.rays,
            walk,
            visit,
            state,
            side="light",
            # One segment more may end at the aperture.
            max_depth=self.max_depth if self.strategies.aperture else self.max_depth - 1,
            roulette=self.roulette,
            heuristic=self.heuristic,
            directions=self.directions,
            renew=None if samples.single else renew,
            going=None if samples.single else samples.going,
            label="elps light walk",
        )
        if samples.single:
            finish(light, mi.Bool(True))
        dr.eval(store.data, store.count, cells)
        return cells

    @staticmethod
    def _full(partial: Partial, lanes: int) -> Partial:
        """As wide as the walk: loop state keeps its size."""
        return Partial(partial.dvcm + dr.zeros(mi.Float, lanes), [r + dr.zeros(mi.Float, lanes) for r in partial.dvc])
