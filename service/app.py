"""The HTTP application: routes, limits and problem documents put together."""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

from fastapi import FastAPI

from service.guard import Guard
from service.problems import ProblemDetails, add_handlers
from service.routes import contexts, health, images, jobs, scenes
from service.settings import ServiceSettings
from worker.farm import Farm

SUMMARY = "Renders hard indirect light without bias, progressively."
DESCRIPTION = """
Upload a scene, create a job, follow its events, fetch its image while it gets better.

Errors are problem documents (RFC 9457): `type` for programs, `detail` for people.
"""


def create_app(farm: Farm, settings: ServiceSettings) -> FastAPI:
    """The ASGI application that serves ``farm``."""
    app = FastAPI(
        title="ELPS",
        version=version("elps"),
        summary=SUMMARY,
        description=DESCRIPTION,
        # The ready-made pages load their scripts from elsewhere; a render farm may have no way out.
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
    )
    app.state.farm = farm
    app.state.turnstile = scenes.Turnstile(settings)
    app.add_middleware(Guard, settings=settings)
    add_handlers(app)
    for module in (health, scenes, jobs, images, contexts):
        app.include_router(module.router)
    _document(app)
    return app


def _document(app: FastAPI) -> None:
    """Completes the OpenAPI document: the problem schema, and no validation error of the framework."""
    generated = app.openapi

    def openapi() -> dict[str, Any]:
        document = generated()
        problem = ProblemDetails.model_json_schema(ref_template="#/components/schemas/{model}")
        schemas = document.setdefault("components", {}).setdefault("schemas", {})
        schemas.update(problem.pop("$defs"))
        schemas["ProblemDetails"] = problem
        return document

    app.openapi = openapi  # type: ignore[method-assign]
