"""One line about why Mitsuba fails while it renders. Imports no Mitsuba.

Its own text comes under one or more errors of Dr.Jit's, which tell no more than that there was one.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

from elps_core.errors import ElpsError, RenderFailed

_SENTENCES = {
    "mesh does not have UV coordinates": "a lamp with a texture needs texture coordinates, which its mesh does not "
    "have: give it some, or choose path, light or bdpt",
    "sample_spectrum(): not implemented": "the light of a lamp's texture cannot be drawn from: make it a bitmap or a "
    "colour, or choose path",
    "eval_parameterization(): not implemented": "a lamp with a texture stands on a shape that can have none: put it on "
    "a mesh, rectangle or sphere, or choose path",
    "eval_1_grad(): not implemented": "a 'bumpmap' has a texture without slopes: make it a bitmap",
    "eval_3(): not implemented": "a texture without three channels stands where a direction or a colour is read, as in "
    "a 'normalmap': make it a bitmap",
    "eval_1(): not implemented": "a texture without a number for each point stands where a number is read: make it a "
    "bitmap",
    "sample_position(): not implemented": "light has to begin at a shape or lamp that no point can be drawn on: choose "
    "path or mi_path",
    "Invalid attribute requested": "a texture asks for an attribute that its shape does not have",
    "out of memory": "there is not enough memory: ask for a smaller image, or make the scene's files smaller",
    "bad_alloc": "there is not enough memory: ask for a smaller image, or make the scene's files smaller",
}
"""Words of Mitsuba's and Dr.Jit's -> what they mean."""
OWN = "ELPS"
"""In place of an integrator's name where several of our own may be at work."""
_THROWN = re.compile(r"\[[A-Z]\w{0,60}\] ")
"""How a text of Mitsuba's begins: with the class that it is about."""


@contextmanager
def told(integrator: str = OWN) -> Iterator[None]:
    """Turn what Mitsuba raises inside into one line.

    Args:
        integrator: its name in the settings. Whatever fails in one of Mitsuba's (``mi_<name>``) is told so. Of what
            fails in our own, only what comes from Mitsuba is, and the rest is raised as it is.

    Raises:
        RenderFailed: so it was; what to change.
    """
    try:
        yield
    except ElpsError:
        raise
    except Exception as error:
        causes = _causes(error)
        if not isinstance(causes[-1], Exception):  # The user has ended it
            raise causes[-1] from None
        texts = [str(cause) for cause in causes]
        reason = next((ours for words, ours in _SENTENCES.items() if any(words in text for text in texts)), None)
        if reason is not None:
            raise RenderFailed(f"{integrator} cannot render this scene: {reason}") from error
        if integrator.startswith("mi_"):
            raise RenderFailed(f"{integrator} cannot render this scene: choose path, or mi_path") from error
        if any(_THROWN.match(text) for text in texts):
            raise RenderFailed(
                f"{integrator} cannot render this scene: Mitsuba fails at one of its materials, textures or lights"
            ) from error
        raise


def _causes(error: BaseException) -> list[BaseException]:
    """An error and what it comes from, the first cause last."""
    found = [error]
    while (cause := found[-1].__cause__) is not None and cause not in found:
        found.append(cause)
    return found
