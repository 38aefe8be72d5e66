"""The random walk that every algorithm shares: extend, visit, scatter [thesis 4.6.1]."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias, TypeVar

import drjit as dr
import mitsuba as mi

from elps_core.paths.mis import Partial
from elps_core.paths.roulette import RouletteRule
from elps_core.paths.scattering import sample_from_eye, sample_from_light
from elps_core.paths.stream import Stream
from elps_core.paths.vertex import Vertex

State = TypeVar("State")
Visit: TypeAlias = "Callable[[Vertex, Stream, State, mi.Bool], State]"
"""Called at every surface vertex with its stream of random numbers, the caller's own state, and
which lanes stand at a vertex; returns the new state. Runs inside the loop's kernel."""


@dataclass
class Walk:
    """State of a walk between two vertices: a ray that was chosen and not yet traced."""

    ray: mi.Ray3f
    beta: mi.Spectrum  # Throughput, including the direction that was just chosen
    partial: Partial  # Partial sums of the weights up to the ray's origin
    eta: mi.Float  # Relative index of refraction along the walk, for roulette by throughput
    depth: mi.UInt32  # Segments traced so far
    offset: mi.Float  # Distance from the subpath's true start to the ray's origin (near clip)
    stream: Stream
    active: mi.Bool


def random_walk(
    scene: mi.Scene,
    start: Walk,
    visit: Visit[State],
    state: State,
    *,
    mode: mi.TransportMode,
    max_depth: int,
    roulette: RouletteRule,
    label: str,
) -> State:
    """Walk from ``start`` over at most ``max_depth`` segments, calling ``visit`` at each vertex.

    ``mode`` is Radiance for walks from the sensor, Importance for walks from the lights, where the
    scattering is adjoint. Returns the caller's state after the last visit. One symbolic loop, hence part of one kernel.
    """

    def body(walk: Walk, state: State) -> tuple[Walk, State]:
        si = scene.ray_intersect(walk.ray, ray_flags=mi.RayFlags.All, coherent=False, active=walk.active)
        active = walk.active & si.is_valid()
        cos_in = dr.abs(dr.dot(si.n, walk.ray.d))
        active = active & (cos_in > 0.0)
        vertex = Vertex(si, walk.beta, walk.partial.arrive(si.t + walk.offset, cos_in), walk.depth + 1)
        state = visit(vertex, walk.stream, state, active)

        active = active & (vertex.depth < max_depth)
        draw = sample_from_light if mode == mi.TransportMode.Importance else sample_from_eye
        event = draw(si, walk.stream.next_1d(), walk.stream.next_2d(), active)
        direction = si.to_world(event.wo)
        cos_out = dr.abs(dr.dot(si.n, direction))
        beta = vertex.beta * event.weight
        eta = walk.eta * event.eta
        active = active & ((event.pdf > 0.0) & (dr.max(beta) > 0.0) & (cos_out > 0.0))

        survival = roulette.survival(beta, eta, event.weight, vertex.depth)
        if roulette.kind != "none":
            active = active & (walk.stream.next_1d() < survival)
        return (
            Walk(
                ray=si.spawn_ray(direction),
                beta=beta / survival,
                partial=vertex.partial.scatter(cos_out, event.pdf, event.pdf_rev, event.delta),
                eta=eta,
                depth=vertex.depth,
                offset=mi.Float(0.0),
                stream=walk.stream,
                active=active,
            ),
            state,
        )

    _, state = dr.while_loop((start, state), lambda walk, _: walk.active, body, label=label)
    return state
