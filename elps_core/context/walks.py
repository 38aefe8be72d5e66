"""Tables from the walks of rendering itself: what eye and light paths find, pass after pass [thesis 5.6.3].

An eye path learns how much light came back along each direction that it took, and brings importance to
every vertex that it visits; a light path brings light. All of it is recorded where it happens, and each
pass is guided by what the ones before have found.

There are more paths than lanes: a lane begins its next path as soon as one has ended. Lanes run in packets, and
would else wait for the longest path of each.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from elps_core.context.directional import DirectionalAccumulator
from elps_core.context.lookup import RegionLookup
from elps_core.context.shares import ShareTrial
from elps_core.integrators.bdpt import Bdpt
from elps_core.particles.records import IMPORTON, PHOTON, ParticleBuffer
from elps_core.paths.scattering import Scattered
from elps_core.paths.stream import Stream
from elps_core.paths.turns import Turns
from elps_core.paths.vertex import Vertex
from elps_core.paths.walk import Walk, random_walk
from elps_core.sampling import lights as region_lights
from elps_core.sampling.lights import NOWHERE
from elps_core.scene.spectrum import luminance, sample_wavelengths, white


@dataclass
class _Eye:
    """What an eye walk carries besides its own state."""

    path: mi.UInt32
    found: mi.Float  # Luminance so far
    records: mi.UInt32
    region: mi.UInt32  # By which a light was chosen at the last vertex


@dataclass
class _Light:
    """What a light walk carries besides its own state."""

    path: mi.UInt32
    scale: mi.UnpolarizedSpectrum  # Weight of the wavelengths


@dataclass(frozen=True)
class Thinned:
    """Particles that are kept one by one, of each region with a chance of its own."""

    chances: mi.Float
    """[regions]"""
    buffer: ParticleBuffer

    def add(
        self,
        si: mi.SurfaceInteraction3f,
        weight: mi.Float,
        depth: mi.UInt32,
        kind: int,
        region: mi.UInt32,
        stream: Stream,
        active: mi.Bool,
    ) -> None:
        """Keep, perhaps, what a walk brings to the surface point ``si`` from where it came."""
        here = active & (stream.next_1d() < dr.gather(mi.Float, self.chances, region, active))
        self.buffer.record(si, weight, depth, kind, here)


class WalkRecorder:
    """Traces eye and light paths of ``bdpt`` and enters what they tell of radiance and importance.

    ``bdpt`` selects path tracing with next event estimation, so that what light sampling covers is no
    part of what a direction is worth. ``regions`` tells where a vertex is, whatever guides the paths.
    """

    def __init__(self, bdpt: Bdpt, regions: RegionLookup) -> None:
        self.bdpt = bdpt
        self._regions = regions

    def eye_paths(
        self,
        position: mi.Point2f,
        stream: Stream,
        radiance: DirectionalAccumulator,
        importance: DirectionalAccumulator,
        lights: mi.Float,
        departures: DirectionalAccumulator | None = None,
        shares: ShareTrial | None = None,
        kept: Thinned | None = None,
        flux: mi.Float | None = None,
    ) -> mi.Float:
        """One path from each ``position`` on the film, in the lanes of ``stream``; the luminance that each has found.

        Importance counts what a pixel is worth, and is left out at the first vertex: joining light paths to the
        sensor covers that. What light sampling finds is added to ``lights`` [regions * pieces], per unit of throughput;
        what reaches the image at all, to ``departures``, by piece and direction. ``shares`` learns what other chances
        of a direction from the tables would have been worth. Some importons are ``kept``. The luminance that the
        cells of the start density bring to the film is added to ``flux`` [columns * rows].
        """
        bdpt = self.bdpt
        pieces = region_lights.pieces(bdpt.lights)
        piece_of = region_lights.PieceOf(bdpt.lights)
        # What roulette makes of it, light paths apply themselves.
        gain = bdpt.worth.gain if bdpt.worth else 1.0
        paths, lanes = dr.width(position), dr.width(stream)
        turns = Turns(paths, lanes)
        dr.eval(position, stream)
        found, records = dr.empty(mi.Float, paths), dr.empty(mi.UInt32, paths)
        where, what = (dr.empty(mi.Float, bdpt.max_depth * paths * 4) for _ in range(2))

        def begin(path: mi.UInt32, stream: Stream, active: mi.Bool) -> Walk:
            primary = bdpt.primary(dr.gather(mi.Point2f, position, path, active), stream)
            return bdpt.eye_start(primary, stream)

        def visit(walk: Walk, vertex: Vertex, eye: _Eye, active: mi.Bool) -> _Eye:
            wavelengths = walk.ray.wavelengths
            emitted, met = bdpt.connector.hit_emitter(walk, vertex, eye.region, active)
            smooth = active & bdpt.connector.surfaces.flags.smooth(vertex.si)
            direct = smooth & (vertex.depth < bdpt.max_depth)
            chosen_by = bdpt.connector.light_region(vertex.si, direct)
            lit, start = bdpt.connector.connect_light(vertex, chosen_by, walk.stream, direct)
            region = self._regions.at(vertex.si, vertex.si.wi, smooth)
            brought = _bright(vertex.beta, wavelengths)
            worth = brought * (walk.worth / gain)
            later = smooth & (vertex.depth > 1)
            importance.add(region, vertex.si.to_world(vertex.si.wi), worth, later)
            if kept:
                kept.add(vertex.si, worth, vertex.depth, IMPORTON, region, walk.stream, smooth)
            if flux is not None:
                for cell, value, some in ((start.cell, lit, direct), (met, emitted, active)):
                    amount = _bright(value, wavelengths)
                    some = some & (amount > 0.0) & dr.isfinite(amount)
                    dr.scatter_reduce(dr.ReduceOp.Add, flux, amount, cell, some)
            if departures:
                at_all = walk.worth / gain
                leave_to = dr.normalize(vertex.si.p - start.point.si.p)
                from_surface = direct & ~(start.point.delta | start.point.infinite)
                bright = _bright(lit, wavelengths) * at_all
                departures.add(piece_of(start.cell, direct), leave_to, bright, from_surface & (bright > 0.0))
                bright = _bright(emitted, wavelengths) * at_all
                seen = active & (vertex.depth > 1) & (bright > 0.0)
                departures.add(piece_of(met, seen), -walk.ray.d, bright, seen)
            if pieces:
                piece = piece_of(start.cell, direct)
                amount = _bright(lit, wavelengths) / brought
                some = direct & dr.isfinite(amount) & (amount > 0.0)
                dr.scatter_reduce(dr.ReduceOp.Add, lights, amount, region * pieces + piece, some)
            return replace(eye, found=eye.found + _bright(emitted + lit, wavelengths), region=chosen_by)

        def leave(walk: Walk, vertex: Vertex, event: Scattered, eye: _Eye, active: mi.Bool) -> _Eye:
            # Where the walk ends it has found nothing: that is a record, too.
            keep = active & bdpt.connector.surfaces.flags.smooth(vertex.si)
            goes_on = keep & walk.active & ~event.delta
            region = self._regions.at(vertex.si, vertex.si.wi, keep)
            # What the walk finds from here on, over its throughput, is the radiance that comes from there. That it has
            # survived roulette is part of what it finds.
            carried = _bright(vertex.beta * event.weight, vertex.si.wavelengths)
            factor = dr.abs(dr.dot(vertex.si.n, walk.ray.d)) / (event.pdf * carried)
            factor = dr.select(goes_on, factor, 0.0)
            index = eye.records * turns.paths + eye.path
            dr.scatter(where, mi.Vector4f(*walk.ray.d, dr.reinterpret_array(mi.Float, region)), index, keep)
            by_table = mi.Float(0.0) if event.by_table is None else event.by_table / event.pdf
            by_table = dr.select(goes_on, by_table, 0.0)
            dr.scatter(what, mi.Vector4f(factor, eye.found, by_table, 0.0), index, keep)
            return replace(eye, records=eye.records + dr.select(keep, mi.UInt32(1), mi.UInt32(0)))

        def renew(walk: Walk, eye: _Eye) -> tuple[Walk, _Eye]:
            ended = ~walk.active
            dr.scatter(found, eye.found, eye.path, ended)
            dr.scatter(records, eye.records, eye.path, ended)
            path, more = turns.after(eye.path, ended)
            fresh = _Eye(path, mi.Float(0.0), mi.UInt32(0), mi.UInt32(NOWHERE))
            return walk.where(more, begin(path, walk.stream, more)), dr.select(ended, fresh, eye)

        nothing = dr.zeros(mi.UInt32, lanes)
        random_walk(
            bdpt.lights.emission.rays,
            begin(turns.first, stream, mi.Bool(True)),
            visit,
            _Eye(turns.first, dr.zeros(mi.Float, lanes), nothing, dr.full(mi.UInt32, NOWHERE, lanes)),
            side="eye",
            max_depth=bdpt.max_depth,
            roulette=bdpt.roulette,
            heuristic=bdpt.heuristic,
            directions=bdpt.directions,
            label="elps training",
            leave=leave,
            renew=renew,
            going=lambda state: turns.left(state.path),
        )
        dr.eval(
            found,
            records,
            where,
            what,
            importance.state,
            lights,
            flux,
            [each.state for each in (departures, kept and kept.buffer) if each],
        )
        number = dr.arange(mi.UInt32, bdpt.max_depth * paths)
        slot = number // turns.paths
        path = number - slot * turns.paths
        some = slot < dr.gather(mi.UInt32, records, path)
        place = dr.gather(mi.Vector4f, where, number, some)
        factor, before, by_table, _ = dr.gather(mi.Vector4f, what, number, some)
        gained = dr.maximum(dr.gather(mi.Float, found, path, some) - before, 0.0)
        region = dr.reinterpret_array(mi.UInt32, place.w)
        radiance.add(region, mi.Vector3f(place.x, place.y, place.z), gained * factor, some)
        if shares and bdpt.worth:
            worth = bdpt.worth(dr.gather(mi.Point2f, position, path, some)) / gain
            shares.add(region, gained * worth, by_table, some & (factor > 0.0))
        dr.eval(radiance.state, shares.sums if shares else None)
        return found

    def light_paths(
        self,
        paths: int,
        stream: Stream,
        radiance: DirectionalAccumulator,
        colours: mi.Float | None = None,
        kept: Thinned | None = None,
    ) -> None:
        """``paths`` from the lights, in the lanes of ``stream``; every vertex is a photon [thesis (5.11)].

        Where light has colours their sums go to ``colours`` [regions * 3], in linear RGB. Some photons are
        ``kept``, those that come straight from a lamp among them.
        """
        bdpt = self.bdpt
        lanes = dr.width(stream)
        turns = Turns(paths, lanes)

        def begin(path: mi.UInt32, stream: Stream, active: mi.Bool) -> tuple[Walk, _Light]:
            wavelengths, scale = sample_wavelengths(stream.next_1d() if mi.is_spectral else mi.Float(0.5))
            active = active & dr.full(mi.Bool, True, lanes)
            start = bdpt.lights.sample(stream.next_2d(), stream.next_2d(), wavelengths, active)
            return bdpt.light_start(start, stream), _Light(path, scale)

        def visit(walk: Walk, vertex: Vertex, light: _Light, active: mi.Bool) -> _Light:
            smooth = active & bdpt.connector.surfaces.flags.smooth(vertex.si)
            region = self._regions.at(vertex.si, vertex.si.wi, smooth)
            # In units of white, as the radiance is that eye paths find over their throughput.
            weight = luminance(mi.UnpolarizedSpectrum(vertex.beta) * light.scale, walk.ray.wavelengths) / white()
            # Light that comes straight from a lamp is the business of light sampling.
            indirect = smooth & (vertex.depth > 1)
            radiance.add(region, vertex.si.to_world(vertex.si.wi), weight, indirect)
            if kept:
                kept.add(vertex.si, weight, vertex.depth, PHOTON, region, walk.stream, smooth)
            if mi.is_rgb and colours is not None:
                for k, amount in enumerate(mi.UnpolarizedSpectrum(vertex.beta)):
                    some = indirect & dr.isfinite(amount)
                    dr.scatter_reduce(dr.ReduceOp.Add, colours, amount, 3 * region + k, some)
            return light

        def renew(walk: Walk, light: _Light) -> tuple[Walk, _Light]:
            ended = ~walk.active
            path, more = turns.after(light.path, ended)
            fresh, state = begin(path, walk.stream, more)
            return walk.where(more, fresh), dr.select(ended, state, light)

        walk, light = begin(turns.first, stream, mi.Bool(True))
        random_walk(
            bdpt.lights.emission.rays,
            walk,
            visit,
            light,
            side="light",
            max_depth=bdpt.max_depth - 1,
            roulette=bdpt.roulette,
            heuristic=bdpt.heuristic,
            directions=bdpt.directions,
            label="elps training by light",
            renew=renew,
            going=lambda state: turns.left(state.path),
        )
        dr.eval(radiance.state, colours, kept.buffer.state if kept else None)


def _bright(value: mi.Spectrum, wavelengths: mi.Spectrum) -> mi.Float:
    """Luminance of what an eye path carries: its throughput starts with the weight of its wavelengths."""
    return luminance(mi.UnpolarizedSpectrum(value), wavelengths)
