"""The scene as connections see it: what stands between two points, and what can scatter at all."""

from __future__ import annotations

import mitsuba as mi

from elps_core.scene.groups import MaterialFlags
from elps_core.scene.meeting import Meeting


class Surfaces:
    """A scene's surfaces. Participating media are left out, as Mitsuba's ``path`` leaves them out."""

    def __init__(self, rays: Meeting, flags: MaterialFlags) -> None:
        """``rays`` are those of a scene, ``flags`` those of its materials."""
        self.scene = rays.scene
        self.leaving = rays.leaving
        self.flags = flags
        self.bends_frames = self.flags.bends_frames
        """Whether a material bends the shading frame and so needs the surface's derivatives by u and v."""

    def shadowed(
        self, si: mi.SurfaceInteraction3f, target: mi.Point3f, on: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> mi.Bool:
        """Whether something stands between a surface point and ``target``, off the surface ``on`` or on none."""
        return self.blocked(self.leaving.to(si, target, self.flags.round(on, active)), active)

    def blocked(self, ray: mi.Ray3f, active: mi.Bool) -> mi.Bool:
        """Whether a ray meets something before its end. All shadow rays are traced here."""
        return self.scene.ray_test(ray, active)

    def may_scatter(self, si: mi.SurfaceInteraction3f, wo: mi.Vector3f) -> mi.Bool:
        """False where a surface that only reflects would have to transmit: spares a shadow ray.

        ``wo`` is local. A bent frame may see ``wo`` on its other side, so there nothing is ruled out.
        """
        if self.bends_frames:
            return mi.Bool(True)
        transmits = self.flags.transmits(si)
        return transmits | (mi.Frame3f.cos_theta(si.wi) * mi.Frame3f.cos_theta(wo) > 0.0)
