"""Requests of the Open Inference Protocol to the model `linear`."""

import numpy as np
import orjson

INFER = "/v2/models/linear/infer"


def infer_request(charges=((100.0, 200.0, 300.0),), datatype="FP32", **more):
    """Return the JSON object of a request with charges, pC."""
    charges = np.atleast_2d(charges)
    tensor = {"name": "charge_pC", "datatype": datatype, "shape": list(charges.shape), "data": charges.ravel().tolist()}
    return {"inputs": [tensor]} | more


BODY = orjson.dumps(infer_request())
