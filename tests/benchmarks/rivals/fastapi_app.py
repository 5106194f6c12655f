"""How many would write it: FastAPI with pydantic models, a plain handler. `python fastapi_app.py PORT MODEL.onnx`"""

import sys

import numpy as np
import onnxruntime as ort
import uvicorn
from fastapi import FastAPI
from pydantic import BaseModel

options = ort.SessionOptions()
options.intra_op_num_threads = options.inter_op_num_threads = 1
session = ort.InferenceSession(sys.argv[2], options, providers=["CPUExecutionProvider"])
names = [output.name for output in session.get_outputs()]
app = FastAPI()


class Tensor(BaseModel):
    name: str
    datatype: str
    shape: list[int]
    data: list[float]


class Request(BaseModel):
    inputs: list[Tensor]
    id: str | None = None


class Response(BaseModel):
    model_name: str
    model_version: str
    outputs: list[Tensor]


@app.post("/v2/models/{name}/infer")
async def infer(name: str, request: Request) -> Response:
    tensor = request.inputs[0]
    charges = np.array(tensor.data, dtype=np.float32).reshape(tensor.shape)
    outputs = [
        Tensor(name=output, datatype="FP32", shape=list(rows.shape), data=rows.ravel().tolist())
        for output, rows in zip(names, session.run(None, {"charge_pC": charges}), strict=True)
    ]
    return Response(model_name=name, model_version="1", outputs=outputs)


if __name__ == "__main__":
    uvicorn.run(app, port=int(sys.argv[1]), loop="uvloop", http="httptools", access_log=False, log_level="critical")
