"""Edges: where faces make an angle or end, the longest first, whatever the mesh is like."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

Array = np.ndarray[Any, Any]


def box(mi: Any, **transform: Any) -> dict[str, Any]:
    return {"type": "cube", "to_world": mi.ScalarTransform4f().scale([1.0, 2.0, 3.0]), **transform}


def found(mi: Any, **shapes: Any) -> Array:
    from elps_core.context.edges import edges

    ends: Array = edges(mi.load_dict({"type": "scene", **shapes}))
    return ends


def lengths(ends: Array) -> Array:
    length: Array = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    return length


def mesh(mi: Any, corners: Array, faces: Array) -> Any:
    made = mi.Mesh("mesh", len(corners), len(faces))
    params = mi.traverse(made)
    params["vertex_positions"] = corners.astype(np.float32).ravel()
    params["faces"] = faces.astype(np.uint32).ravel()
    params.update()
    return made


def test_a_box_has_twelve(mi: Any) -> None:
    """Not the diagonals of its sides, though no two of its sides have a vertex in common."""
    assert lengths(found(mi, box=box(mi))) == pytest.approx(np.repeat([6.0, 4.0, 2.0], 4), rel=1e-5)


def test_a_rectangle_ends_on_four_sides(mi: Any) -> None:
    assert lengths(found(mi, side={"type": "rectangle"})) == pytest.approx([2.0] * 4)


def test_shapes_without_faces_have_none(mi: Any) -> None:
    assert found(mi, ball={"type": "sphere"}).shape == (0, 2, 3)
    assert found(mi).shape == (0, 2, 3)


def test_bent_sheets_have_edges_where_they_are_sharp(mi: Any) -> None:
    """Three strips, of which the second one is turned by so many degrees, and the third one by as many more."""
    for degrees, expected in ((5.0, 2), (25.0, 4)):
        angles = np.radians([0.0, degrees, 2.0 * degrees])
        profile = np.concatenate([[[0.0, 0.0]], np.cumsum(np.stack([np.cos(angles), np.sin(angles)], axis=1), axis=0)])
        corners = np.array([[*point, z] for point in profile for z in (0.0, 5.0)])
        faces = np.array([[2 * i + a for a in corner] for i in range(3) for corner in ((0, 2, 3), (0, 3, 1))])
        long = lengths(found(mi, sheet=mesh(mi, corners, faces))) > 4.0
        assert long.sum() == expected


def test_short_edges_do_not_count(mi: Any) -> None:
    small = box(mi) | {"to_world": mi.ScalarTransform4f().scale(0.01)}
    assert len(found(mi, small=small, big=box(mi))) == 12


def test_faces_without_area_do_no_harm(mi: Any) -> None:
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.5, 0.0, 0.0]])
    ends = found(mi, sheet=mesh(mi, corners, np.array([[0, 1, 2], [0, 1, 3], [0, 0, 0]])))
    assert np.isfinite(ends).all()
    assert (lengths(ends) > 0.0).all()


def test_the_longest_are_kept(mi: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    import elps_core.context.edges as module

    monkeypatch.setattr(module, "MOST", 5)
    assert lengths(found(mi, box=box(mi))) == pytest.approx([6.0] * 4 + [4.0], rel=1e-5)
