"""One way to render a scene by any algorithm: independent images for statistical comparison."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from elps_core.context.store import DirectionalParts
from elps_core.settings import DEPTH_BASELINES, RenderSettings, with_overrides

Array = np.ndarray[Any, Any]
Table = Callable[[Any], Array]
"""From an ``Emission`` to weights over the start density's cells."""

WAYS: dict[str, dict[str, Any]] = {
    "path": {"integrator": "path"},
    "path pure": {"integrator": "path", "path.next_event": False},
    "light": {"integrator": "light"},
    "light pure": {"integrator": "light", "light.connect": False},
    "bdpt": {"integrator": "bdpt"},
    "pssmlt": {"integrator": "pssmlt"},
}
"""Algorithm of our own -> the settings that choose it."""
NAIVE = "naive"
"""A reference of a dozen lines: walks that count what they meet, without weights, joins or light sampling."""
RR_DEPTH = 3
"""Roulette starts early, so that small scenes have some."""
REFERENCE_SEED = 1 << 31
"""Seeds of the references lie apart from those of the images under test."""

Sampler = Callable[[int, int], Array]
"""From the number of an image and samples per pixel to the image [height, width, 3]."""


def sampler(
    scene: Any,
    algorithm: str,
    *,
    max_depth: int,
    seed: int = 0,
    table: Table | None = None,
    parts: DirectionalParts | None = None,
    **options: Any,
) -> Sampler:
    """What renders independent images of a scene that ``mi.load_dict`` made, by its first sensor.

    ``algorithm`` is one of :data:`WAYS`, or ``mi_<name>`` for an integrator of Mitsuba without roulette.
    ``parts`` guide directions, lights and roulette by context. ``options`` are settings by their dotted names with two
    underscores for each dot (``bdpt__weighted=False``).
    """
    if algorithm == NAIVE:
        return _naive(scene, max_depth, seed)
    if algorithm.startswith("mi_"):
        return _baseline(scene, algorithm[3:], max_depth, seed)
    from elps_core.integrators import make
    from elps_core.sampling.start import StartDensity
    from elps_core.scene.emission import Emission

    chosen = {
        "max_depth": max_depth,
        "light_sampling": "power",  # The table is given here: no context is looked for.
        "rr_depth": RR_DEPTH,
        **({"direction_sampling": "context", "roulette": "context", "light_sampling": "adjoint"} if parts else {}),
        **WAYS[algorithm],
        **{name.replace("__", "."): value for name, value in options.items()},
    }
    emission = Emission(scene)
    lights = StartDensity(emission, (table or uneven_table)(emission))
    frames = make.frames(scene, scene.sensors()[0], lights, with_overrides(RenderSettings(), chosen), parts)
    return lambda index, spp: np.array(frames.render(spp, (seed, index)).image)


def render(scene: Any, algorithm: str, *, images: int, spp: int, max_depth: int, **options: Any) -> Array:
    """Independent images [n, height, width, 3]; arguments as for :func:`sampler`."""
    draw = sampler(scene, algorithm, max_depth=max_depth, **options)
    return np.stack([draw(index, spp) for index in range(images)])


def uneven_table(emission: Any) -> Array:
    """Emitters by their power, and on each a density with a contrast of three to one.

    A table with structure makes F and its inverse matter, which a constant one does not.
    """
    pattern = np.random.default_rng(7).uniform(0.5, 1.5, (8, 4 * emission.count))
    return np.asarray(pattern * np.repeat(np.maximum(emission.power, 1e-3 * emission.power.max()), 4))


def _baseline(scene: Any, name: str, max_depth: int, seed: int) -> Sampler:
    import drjit as dr
    import mitsuba as mi

    from elps_core.paths.stream import key_seed

    depths = {"max_depth": max_depth, "rr_depth": max_depth + 1} if name in DEPTH_BASELINES else {}
    integrator = mi.load_dict({"type": name, **depths})

    def draw(index: int, spp: int) -> Array:
        # A seed that is data: with each one in the code, each image would be a kernel of its own.
        number = dr.opaque(mi.UInt32, key_seed(REFERENCE_SEED, seed, index) & 0xFFFFFFFF)
        pixels = np.array(mi.render(scene, integrator=integrator, spp=spp, seed=number))
        return np.repeat(pixels[..., :1], 3, axis=-1) if pixels.shape[-1] < 3 else pixels[..., :3]

    return draw


def _naive(scene: Any, max_depth: int, seed: int) -> Sampler:
    import drjit as dr
    import mitsuba as mi

    from elps_core.paths.stream import key_seed

    class Naive(mi.ad.integrators.common.ADIntegrator):  # type: ignore[misc]
        """Brute force."""

        def sample(
            self, mode: Any, scene: Any, sampler: Any, ray: Any, depth: Any = None, active: Any = True, **_: Any
        ) -> Any:
            def body(sampler: Any, ray: Any, radiance: Any, beta: Any, depth: Any, active: Any) -> Any:
                si = scene.ray_intersect(ray, active)
                radiance = radiance + beta * si.emitter(scene, active).eval(si, active)
                active = active & si.is_valid() & (depth + 1 < max_depth)
                found, weight = si.bsdf().sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d(), active)
                beta = beta * weight
                active = active & (dr.max(beta) > 0.0)
                return sampler, si.spawn_ray(si.to_world(found.wo)), radiance, beta, depth + 1, active

            state = (sampler, mi.Ray3f(ray), mi.Spectrum(0.0), mi.Spectrum(1.0), mi.UInt32(0), mi.Bool(active))
            _, _, radiance, _, _, _ = dr.while_loop(state, lambda *state: state[-1], body, label="naive")
            return radiance, mi.Bool(active), [], None

    integrator = Naive(mi.Properties())

    def draw(index: int, spp: int) -> Array:
        number = key_seed(REFERENCE_SEED, seed, index) & 0xFFFFFFFF
        return np.array(mi.render(scene, integrator=integrator, spp=spp, seed=dr.opaque(mi.UInt32, number)))[..., :3]

    return draw
