"""The HTTP application for an ASGI server of your own: ``uvicorn --app-dir deploy asgi:app``.

There are no keys yet, so that ``elps serve`` listens on the loopback interface only. Where a
container gives the API an interface of its own, it is the container's settings that must keep
others out: docker-compose.yml publishes the port on 127.0.0.1. Requests that name another host
are refused here as there.
"""

from __future__ import annotations

from service.app import create_app
from service.settings import ServiceSettings
from worker.farm import Farm
from worker.settings import FarmSettings

app = create_app(Farm.connect(FarmSettings()), ServiceSettings())
