"""The random walk that every algorithm shares: extend, visit, scatter [thesis 4.6.1]."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias, TypeVar

import drjit as dr
import mitsuba as mi

from elps_core.paths.mis import Heuristic, Partial, Side
from elps_core.paths.roulette import RouletteRule
from elps_core.paths.scattering import Scattered
from elps_core.paths.stream import Stream
from elps_core.paths.vertex import Vertex
from elps_core.sampling.direction import Directions
from elps_core.scene.meeting import Meeting
from elps_core.settings import MAX_DEPTH

State = TypeVar("State")
Visit: TypeAlias = "Callable[[Walk, Vertex, State, mi.Bool], State]"
"""Called after every segment with the walk that made it (its ray, its stream of random numbers), the
vertex at its end, the caller's own state, and which lanes stand at a surface vertex; lanes that are
active in the walk and not there have left the scene, and the vertex tells in which direction. Returns
the new state. Runs inside the loop's kernel, and may change the vertex's partial sums."""
Leave: TypeAlias = "Callable[[Walk, Vertex, Scattered, State, mi.Bool], State]"
"""Called when a direction has been chosen, with the walk that will take it (active where it goes on), the vertex that
it leaves, the event, the caller's state, and which lanes were asked. Returns the new state."""

Pay: TypeAlias = "Callable[[State, mi.Spectrum], State]"
"""Adds what roulette pays, which is negative for a path that goes on, to the caller's state."""
Renew: TypeAlias = "Callable[[Walk, State], tuple[Walk, State]]"
"""Called after every step; may put another walk in place of one that has ended, and the state that it starts with."""
Going: TypeAlias = "Callable[[State], mi.Bool]"
"""Which lanes have a walk to finish: one that is renewed may be at its end from the start, and others wait for it."""


@dataclass
class Walk:
    """State of a walk between two vertices: a ray that was chosen and not yet traced."""

    ray: mi.Ray3f
    beta: mi.Spectrum  # Throughput, including the direction that was just chosen
    partial: Partial  # Partial sums of the weights up to the ray's origin
    eta: mi.Float  # Relative index of refraction along the walk, for roulette by throughput
    depth: mi.UInt32  # Segments traced so far
    offset: mi.Float  # Distance from the subpath's true start to the ray's origin (near clip)
    parallel: mi.Bool  # Whether the first segment is one of parallel rays, so that its length does not count
    raised: mi.Float  # How much roulette has raised the throughput, over what the materials have absorbed
    worth: mi.Float  # What a unit of luminance is worth where the path will count, for roulette by context
    stream: Stream
    active: mi.Bool

    def where(self, chosen: mi.Bool, other: Walk) -> Walk:
        """``other``, whose stream belongs to another sample, in ``chosen`` lanes, and this walk elsewhere."""
        fields = {
            name: dr.select(chosen, getattr(other, name), value)
            for name, value in vars(self).items()
            if name != "stream"
        }
        return Walk(**fields, stream=self.stream.where(chosen, other.stream))


def random_walk(
    rays: Meeting,
    start: Walk,
    visit: Visit[State],
    state: State,
    *,
    side: Side,
    max_depth: int | mi.UInt32,
    roulette: RouletteRule,
    heuristic: Heuristic,
    label: str,
    directions: Directions,
    leave: Leave[State] | None = None,
    pay: Pay[State] | None = None,
    renew: Renew[State] | None = None,
    going: Going[State] | None = None,
) -> State:
    """Walk from ``start`` over at most ``max_depth`` segments, calling ``visit`` after each.

    With more than :data:`elps_core.settings.MAX_DEPTH` segments roulette alone ends the walk.
    ``side`` is where the walk starts: from the lights the scattering is adjoint. With ``pay`` roulette by context
    may pay for what it ends. Returns the caller's state after the last visit. One symbolic loop, hence part of one
    kernel.
    """

    def extend(walk: Walk, state: State) -> tuple[Vertex, State, mi.Bool]:
        si = rays.ray_intersect(walk.ray, ray_flags=mi.RayFlags.All, coherent=False, active=walk.active)
        active = walk.active & si.is_valid()
        # Rays that leave the scene arrive nowhere: their densities stay those of directions.
        cos_in = dr.select(active, dr.abs(dr.dot(si.n, walk.ray.d)), 1.0)
        distance2 = dr.select(walk.parallel | ~active, 1.0, dr.square(si.t + walk.offset))
        vertex = Vertex(si, walk.beta, heuristic.arrive(walk.partial, distance2, cos_in), walk.depth + 1)
        # No density is finite on a surface that is seen along its tangent.
        walk.active = walk.active & (cos_in > 0.0)
        active = active & walk.active
        return vertex, visit(walk, vertex, state, active), active

    if isinstance(max_depth, int) and max_depth == 1 and not renew:
        return extend(start, state)[1]

    def body(walk: Walk, state: State) -> tuple[Walk, State]:
        vertex, state, active = extend(walk, state)
        si = vertex.si
        active = active & (vertex.depth < max_depth)
        event = directions.sample(si, walk.stream, side, active)
        direction = si.to_world(event.wo)
        cos_out = dr.abs(dr.dot(si.n, direction))
        beta = vertex.beta * event.weight
        eta = walk.eta * event.eta
        scattered = active
        # A material that reflects nothing may give 0 / 0, which is no light either.
        active = active & ((event.pdf > 0.0) & (dr.max(beta) > 0.0) & (cos_out > 0.0) & dr.isfinite(dr.sum(beta)))

        survival = roulette.survival(beta, eta, event.albedo, vertex.depth)
        kept = dr.select(vertex.depth >= roulette.start, dr.minimum(dr.max(event.albedo), 1.0), 1.0)
        if roulette.kind == "context":
            outlook = directions.expected(si, event, direction, cos_out, beta, side, active)
            if pay and roulette.pays:
                spread = outlook.value * outlook.deviation * walk.worth
                survival, paid = roulette.paid(spread, vertex.depth, outlook.known, survival)
            else:
                known = outlook.known & (vertex.depth >= roulette.start)
                survival = roulette.by_worth(outlook.value * walk.worth, walk.raised * kept, known, survival)
        if roulette.kind == "context" and isinstance(max_depth, int) and max_depth > MAX_DEPTH:
            survival = roulette.in_the_end(survival, vertex.depth)
        if roulette.kind != "none":
            before, active = active, active & (walk.stream.next_1d(even=False) < survival)
        if pay and roulette.pays:
            # The mean of this is nothing, whatever is paid: 1 at the end, and 1 - 1 / q with probability q.
            amount = outlook.light * dr.select(active, 1.0 - dr.rcp(survival), 1.0)
            state = pay(state, dr.select(before & paid, amount, 0.0))
        after = Walk(
            ray=rays.leaving.ray(si, direction),
            beta=beta / survival,
            partial=heuristic.scatter(
                vertex.partial, cos_out, event.pdf, event.pdf_rev, event.delta, side, vertex.depth == 1
            ),
            eta=eta,
            depth=vertex.depth,
            offset=mi.Float(0.0),
            parallel=mi.Bool(False),
            raised=walk.raised * kept / survival,
            worth=walk.worth,
            stream=walk.stream,
            active=active,
        )
        if leave:
            state = leave(after, vertex, event, state, scattered)
        return renew(after, state) if renew else (after, state)

    def more(walk: Walk, state: State) -> mi.Bool:
        return going(state) if going else walk.active

    _, state = dr.while_loop((start, state), more, body, label=label)
    return state
