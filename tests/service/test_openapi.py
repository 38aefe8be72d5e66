"""The OpenAPI document is complete, and the service keeps to it under generated requests."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import httpx

from elps_core.settings import INTEGRATORS
from service.models import JobRequest

PROBLEM = "application/problem+json"
SECONDS = 12
"""Time for generated requests."""


def test_every_operation_is_described(client: httpx.Client) -> None:
    document = client.get("/openapi.json").json()
    assert document["openapi"].startswith("3.1")
    names = set()
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            where = f"{method} {path}"
            assert operation["summary"], where
            assert operation["description"], where
            assert operation["operationId"] not in names, where
            names.add(operation["operationId"])
            assert not operation["operationId"].endswith(f"_{method}"), where
            assert "500" in operation["responses"], where
            for status, answer in operation["responses"].items():
                if int(status) >= 400:
                    assert list(answer["content"]) == [PROBLEM], where
                    assert answer["content"][PROBLEM]["examples"], where
    assert "HTTPValidationError" not in document["components"]["schemas"]
    assert document["components"]["schemas"]["JobRequest"]["examples"]


def test_every_algorithm_is_described(client: httpx.Client) -> None:
    schemas = client.get("/openapi.json").json()["components"]["schemas"]
    assert schemas["RenderSettings"]["properties"]["integrator"]["enum"] == list(INTEGRATORS)
    assert schemas["PssmltSettings"]["properties"]["chains"]["maximum"] == 2**18
    assert schemas["BdptSettings"]["properties"]["strategies"]["pattern"]
    assert {"warnings", "statistics"} <= set(schemas["Job"]["properties"])
    for example in schemas["JobRequest"]["examples"]:
        JobRequest.model_validate(example)


def test_service_keeps_to_its_document(client: httpx.Client, scene: str, tmp_path: Path) -> None:
    """Schemathesis: statuses, media types, headers, schemas, refusal of invalid data, unsupported methods.

    Left out are the stream of events, which lasts as long as its job, and two demands: that whatever
    fits the schema is accepted (most XML is no scene), and that all below a new resource exists (a
    job's images come later).
    """
    config = tmp_path / "schemathesis.toml"
    config.write_text(f'[parameters]\ndigest = "{scene}"\n')
    command = [
        *(sys.executable, "-m", "schemathesis.cli", "--config-file", str(config)),
        *("run", f"{client.base_url}/openapi.json", "--no-color", "--seed", "1"),
        *("--max-time", str(SECONDS), "--max-examples", "5", "--request-timeout", "20"),
        *("--checks", "all", "--exclude-checks", "positive_data_acceptance,ensure_resource_availability"),
        *("--exclude-operation-id", "followJob"),
    ]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert client.get("/livez").json() == {"status": "ok"}
