"""schemathesis makes requests from the OpenAPI document, good ones and bad ones, and compares answers with it."""

import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from schemathesis import GenerationMode
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    negative_data_rejection,
    response_schema_conformance,
    status_code_conformance,
)

CHECKS = [
    not_a_server_error,
    content_type_conformance,
    negative_data_rejection,
    response_schema_conformance,
    status_code_conformance,
]


@pytest.fixture
def operations(handler, start_http):
    """What the document offers, as a client gets it; nobody unloads the models in the middle."""
    api = schemathesis.openapi.from_url(start_http(handler).url + "/openapi.json")
    return [result.ok() for result in api.exclude(path_regex="unload").get_all_operations()]


@pytest.mark.slow
@pytest.mark.parametrize("mode", GenerationMode, ids=lambda mode: mode.value)
def test_the_server_does_what_its_document_says(operations, mode):
    assert len(operations) == 17
    answered = set()
    for operation in operations:
        if mode is GenerationMode.NEGATIVE and not (operation.path_parameters or operation.body):
            continue  # nothing that could be wrong

        @settings(max_examples=20, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck))
        @given(operation.as_strategy(generation_mode=mode))
        def conforms(case):
            response = case.call()
            case.validate_response(response, checks=CHECKS)
            assert response.status_code == 200 or "error" in response.json()
            answered.add(response.status_code)

        conforms()
    assert answered & ({200} if mode is GenerationMode.POSITIVE else {400, 404})
