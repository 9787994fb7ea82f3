"""The server keeps to its own OpenAPI description, whatever a request contains."""

from __future__ import annotations

import pytest
import schemathesis
from hypothesis import HealthCheck, settings
from schemathesis.config import SchemathesisConfig

from epypes.service.http.app import create_app

pytestmark = pytest.mark.slow

# What is as described may still be refused for what the service knows: no such token, a value beyond its range.
CONFIG = {
    "checks": {
        "positive_data_acceptance": {"expected-statuses": ["2xx", "401", "403", "404", "409", "422"]},
        "negative_data_rejection": {
            "expected-statuses": ["400", "401", "403", "404", "405", "413", "414", "415", "421", "422"]
        },
    },
}

schema = schemathesis.openapi.from_dict(create_app(None).openapi(), config=SchemathesisConfig.from_dict(CONFIG))


@pytest.mark.fuzz
@schema.parametrize()
@settings(
    max_examples=settings().max_examples // 8,
    deadline=None,
    suppress_health_check=list(HealthCheck),
    derandomize=True,
    database=None,
)
def test_every_operation_keeps_to_its_description(case, http):
    if case.operation.path == "/v1/events" and _lasts(case.query.get("for_s")):
        case.query["for_s"] = 0.01
    case.call_and_validate(base_url=http.url, headers={"Authorization": f"Bearer {http.token}"}, timeout=60)


def _lasts(for_s):
    """Whether a listener would listen on and on."""
    if for_s is None:
        return True
    try:
        return 0.01 < float(for_s) <= 86_400
    except (TypeError, ValueError):
        return False
