"""OpenAPI document that describes the routes of the HTTP server."""

from collections.abc import Iterable
from typing import Any

import msgspec

from isocharge.serve.network.model_store import ModelStore
from isocharge.serve.network.protocol.describe import server_metadata
from isocharge.serve.network.protocol.routes import Json, Route, Schema, object_schema

ERROR = Schema("error", object_schema({"error": {"type": "string"}}))
"""Schema of the answer to a request that is refused."""

DESCRIPTION = (
    "Computes contacts on a piezoelectric tactile film from the charges of its electrodes, with the Open Inference "
    "Protocol, version 2. The input `charge_pC` has one row for each press and one column for each electrode: the "
    "charge under load minus the charge without load, in pC. Bodies may be compressed with gzip or deflate, and "
    "tensors may follow the JSON in binary, as in the binary tensor extension of the protocol."
)

REFERENCE = "#/components/schemas/{name}"


def openapi_document(routes: Iterable[Route], store: ModelStore) -> Json:
    """Return the OpenAPI document, version 3.1, as a JSON object.

    The document describes the routes that have a summary. The document also lists the names and versions of the loaded
    models.
    """
    documented_routes = [route for route in routes if route.summary]
    models = {loaded.metadata.name for loaded in store.loaded_versions()}
    versions = {loaded.version for loaded in store.loaded_versions()}
    return {
        "openapi": "3.1.0",
        "info": {"title": "isocharge", "version": server_metadata()["version"], "description": DESCRIPTION},
        "paths": {path: _path_item(path, route) for route in documented_routes for path in route.paths},
        "components": {
            "parameters": {"model": _path_parameter("model", models), "version": _path_parameter("version", versions)},
            "schemas": _schemas(documented_routes),
            "responses": {
                "error": {"description": "Reason for the refusal", "content": _content(ERROR, "application/json")}
            },
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
        },
        "security": [{}, {"token": []}],  # either nothing or a token, because not every server has a token
    }


def _path_item(path: str, route: Route) -> Json:
    """Return the OpenAPI description of a path.

    The description contains the parameters in the path, the method, the body of the request, and the responses.

    Args:
        path: Template of the path.
        route: Route of the path.
    """
    operation: Json = {
        "summary": route.summary,
        "responses": {
            "200": {"description": route.summary, "content": _content(route.answer, route.answer_type)},
            "4XX": {"$ref": "#/components/responses/error"},
        },
    }
    if route.body is not None:
        content = _content(route.body.schema, "application/json")
        if route.body.example is not None:
            content["application/json"]["example"] = route.body.example
        operation["requestBody"] = {"content": content}
        if route.body.is_required:
            operation["requestBody"]["required"] = True
    parameter_names = [name for name in ("model", "version") if "{" + name + "}" in path]
    parameters = [{"$ref": f"#/components/parameters/{name}"} for name in parameter_names]
    return {"parameters": parameters, route.method.lower(): operation}


def _content(schema: Schema, media_type: str) -> Json:
    """Return the description of a body, which contains its media type and a reference to its schema."""
    return {media_type: {"schema": {"$ref": REFERENCE.format(name=schema.name)}}}


def _path_parameter(name: str, values: set[str]) -> Json:
    """Return the description of a parameter of a path, including its possible values.

    Args:
        name: Name of the parameter: "model" or "version".
        values: The possible values, which are the names or the versions of the loaded models. Without values, the
            description contains the value "none", because OpenAPI requires at least one.
    """
    schema = {"type": "string", "enum": sorted(values) or ["none"]}
    return {"name": name, "in": "path", "required": True, "schema": schema}


def _schemas(routes: Iterable[Route]) -> dict[str, Any]:
    """Return the schemas of all bodies and answers of the given routes, by name.

    The content of a schema is either given as a JSON object, or derived from a type. A derived schema may refer to
    further schemas, which the result also contains.
    """
    used_schemas = [ERROR]
    for route in routes:
        used_schemas.append(route.answer)
        if route.body is not None:
            used_schemas.append(route.body.schema)

    content_by_name: dict[str, Any] = {}
    for schema in used_schemas:
        if isinstance(schema.content, type):
            _, derived_content_by_name = msgspec.json.schema_components([schema.content], ref_template=REFERENCE)
            content_by_name |= derived_content_by_name
        else:
            content_by_name[schema.name] = schema.content
    return content_by_name
