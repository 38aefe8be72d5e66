"""Tables from the walks of rendering itself: what eye and light paths find, pass after pass [thesis 5.6.3].

An eye path learns how much light came back along each direction that it took, and brings importance to
every vertex that it visits; a light path brings light. All of it is recorded where it happens, and each
pass is guided by what the ones before have found.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from elps_core.context.directional import DirectionalAccumulator
from elps_core.integrators.bdpt import Bdpt
from elps_core.paths.scattering import Scattered
from elps_core.paths.stream import Stream
from elps_core.paths.vertex import Vertex
from elps_core.paths.walk import Walk, random_walk
from elps_core.sampling import lights as region_lights
from elps_core.sampling.direction import GuidedDirections
from elps_core.sampling.lights import NOWHERE
from elps_core.scene.spectrum import luminance, sample_wavelengths


@dataclass
class _Eye:
    """What an eye walk carries besides its own state."""

    found: mi.Float  # Luminance so far
    records: mi.UInt32
    region: mi.UInt32  # By which a light was chosen at the last vertex


class WalkRecorder:
    """Traces eye and light paths of ``bdpt`` and enters what they tell of radiance and importance.

    ``bdpt`` selects path tracing with next event estimation, so that what light sampling covers is no
    part of what a direction is worth. ``regions`` tells where a vertex is, whatever guides the paths.
    """

    def __init__(self, bdpt: Bdpt, regions: GuidedDirections) -> None:
        self.bdpt = bdpt
        self._regions = regions

    def eye_paths(
        self,
        position: mi.Point2f,
        stream: Stream,
        radiance: DirectionalAccumulator,
        importance: DirectionalAccumulator,
        lights: mi.Float,
    ) -> mi.Float:
        """One path per lane from ``position`` on the film; returns the luminance that each has found.

        Importance counts what a pixel is worth, and is left out at the first vertex: joining light paths to the
        sensor covers that. What light sampling finds is added to ``lights`` [regions * pieces], per unit of throughput.
        """
        bdpt = self.bdpt
        pieces = region_lights.pieces(bdpt.lights)
        cells_per_piece = bdpt.lights.rows * bdpt.lights.columns // max(1, pieces)
        # What roulette makes of it, light paths apply themselves.
        gain = bdpt.worth.gain if bdpt.worth else 1.0
        lanes = dr.width(position)
        primary = bdpt.primary(position, stream)
        wavelengths, scale = primary.ray.wavelengths, mi.UnpolarizedSpectrum(primary.weight)
        stride, lane = dr.opaque(mi.UInt32, lanes), dr.arange(mi.UInt32, lanes)
        where, what = (dr.empty(mi.Float, bdpt.max_depth * lanes * size) for size in (4, 2))

        def bright(value: mi.Spectrum) -> mi.Float:
            return luminance(mi.UnpolarizedSpectrum(value) * scale, wavelengths)

        def visit(walk: Walk, vertex: Vertex, eye: _Eye, active: mi.Bool) -> _Eye:
            emitted, _ = bdpt.connector.hit_emitter(walk, vertex, eye.region, active)
            smooth = active & mi.has_flag(vertex.si.bsdf().flags(), mi.BSDFFlags.Smooth)
            direct = smooth & (vertex.depth < bdpt.max_depth)
            chosen_by = bdpt.connector.light_region(vertex.si, direct)
            lit, start = bdpt.connector.connect_light(vertex, chosen_by, walk.stream, direct)
            region = self._regions.region(vertex.si, vertex.si.wi, smooth)
            worth = bright(vertex.beta) * (walk.worth / gain)
            importance.add(region, vertex.si.to_world(vertex.si.wi), worth, smooth & (vertex.depth > 1))
            if pieces:
                piece = start.cell // cells_per_piece
                amount = bright(lit) / bright(vertex.beta)
                some = direct & dr.isfinite(amount) & (amount > 0.0)
                dr.scatter_reduce(dr.ReduceOp.Add, lights, amount, region * pieces + piece, some)
            return _Eye(eye.found + bright(emitted + lit), eye.records, chosen_by)

        def leave(walk: Walk, vertex: Vertex, event: Scattered, eye: _Eye, active: mi.Bool) -> _Eye:
            # Where the walk ends it has found nothing: that is a record, too.
            keep = active & mi.has_flag(vertex.si.bsdf().flags(), mi.BSDFFlags.Smooth)
            goes_on = keep & walk.active & ~event.delta
            region = self._regions.region(vertex.si, vertex.si.wi, keep)
            # What the walk finds from here on, over its throughput, is the radiance that comes from there. That it has
            # survived roulette is part of what it finds.
            factor = dr.abs(dr.dot(vertex.si.n, walk.ray.d)) / (event.pdf * bright(vertex.beta * event.weight))
            factor = dr.select(goes_on, factor, 0.0)
            index = eye.records * stride + lane
            dr.scatter(where, mi.Vector4f(*walk.ray.d, dr.reinterpret_array(mi.Float, region)), index, keep)
            dr.scatter(what, mi.Vector2f(factor, eye.found), index, keep)
            return _Eye(eye.found, eye.records + dr.select(keep, mi.UInt32(1), mi.UInt32(0)), eye.region)

        eye = random_walk(
            bdpt.scene,
            bdpt.eye_start(primary, stream),
            visit,
            _Eye(dr.zeros(mi.Float, lanes), dr.zeros(mi.UInt32, lanes), dr.full(mi.UInt32, NOWHERE, lanes)),
            side="eye",
            max_depth=bdpt.max_depth,
            roulette=bdpt.roulette,
            heuristic=bdpt.heuristic,
            directions=bdpt.directions,
            label="elps training",
            leave=leave,
        )
        dr.eval(eye, where, what, importance.state, lights)
        number = dr.arange(mi.UInt32, bdpt.max_depth * lanes)
        slot = number // stride
        of = number - slot * stride
        some = slot < dr.gather(mi.UInt32, eye.records, of)
        place, (factor, before) = (
            dr.gather(mi.Vector4f, where, number, some),
            dr.gather(mi.Vector2f, what, number, some),
        )
        weight = dr.maximum(dr.gather(mi.Float, eye.found, of, some) - before, 0.0) * factor
        radiance.add(dr.reinterpret_array(mi.UInt32, place.w), mi.Vector3f(place.x, place.y, place.z), weight, some)
        dr.eval(radiance.state)
        return eye.found

    def light_paths(self, lanes: int, stream: Stream, radiance: DirectionalAccumulator) -> None:
        """One path per lane from the lights; every vertex is a photon [thesis (5.11)]."""
        bdpt = self.bdpt
        wavelengths, scale = sample_wavelengths(stream.next_1d() if mi.is_spectral else mi.Float(0.5))
        start = bdpt.lights.sample(stream.next_2d(), stream.next_2d(), wavelengths, dr.full(mi.Bool, True, lanes))

        def visit(_: Walk, vertex: Vertex, none: mi.Bool, active: mi.Bool) -> mi.Bool:
            smooth = active & mi.has_flag(vertex.si.bsdf().flags(), mi.BSDFFlags.Smooth)
            region = self._regions.region(vertex.si, vertex.si.wi, smooth)
            weight = luminance(mi.UnpolarizedSpectrum(vertex.beta) * scale, wavelengths)
            # Light that comes straight from a lamp is the business of light sampling.
            radiance.add(region, vertex.si.to_world(vertex.si.wi), weight, smooth & (vertex.depth > 1))
            return none

        random_walk(
            bdpt.scene,
            bdpt.light_start(start, stream),
            visit,
            dr.zeros(mi.Bool, lanes),
            side="light",
            max_depth=bdpt.max_depth - 1,
            roulette=bdpt.roulette,
            heuristic=bdpt.heuristic,
            directions=bdpt.directions,
            label="elps training by light",
        )
        dr.eval(radiance.state)
