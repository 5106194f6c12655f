"""The least that can answer: one route, raw ASGI, nothing checked. `python bare_app.py PORT MODEL.onnx`"""

import sys

import numpy as np
import onnxruntime as ort
import orjson
import uvicorn

options = ort.SessionOptions()
options.intra_op_num_threads = options.inter_op_num_threads = 1
session = ort.InferenceSession(sys.argv[2], options, providers=["CPUExecutionProvider"])
names = [output.name for output in session.get_outputs()]


async def app(_, receive, send):
    body = (await receive())["body"]
    tensor = orjson.loads(body)["inputs"][0]
    charges = np.array(tensor["data"], dtype=np.float32).reshape(tensor["shape"])
    outputs = [
        {"name": name, "datatype": "FP32", "shape": rows.shape, "data": rows.ravel()}
        for name, rows in zip(names, session.run(None, {"charge_pC": charges}), strict=True)
    ]
    content = {"model_name": "model", "model_version": "1", "outputs": outputs}
    answer = orjson.dumps(content, option=orjson.OPT_SERIALIZE_NUMPY)
    headers = [(b"content-type", b"application/json"), (b"content-length", b"%d" % len(answer))]
    await send({"type": "http.response.start", "status": 200, "headers": headers})
    await send({"type": "http.response.body", "body": answer})


if __name__ == "__main__":
    uvicorn.run(
        app,
        port=int(sys.argv[1]),
        loop="uvloop",
        http="httptools",
        ws="none",
        lifespan="off",
        access_log=False,
        log_level="critical",
    )
