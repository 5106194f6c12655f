"""Ten lines that give the same answer: a route in raw ASGI with a Predictor. `python bare_app.py MODEL.onnx PORT`"""

import sys
from pathlib import Path

import orjson
import uvicorn

from isocharge.serve import Predictor

touch = Predictor(Path(sys.argv[1]).parent)
OUTPUTS = {"contact": (0, 3), "contact_std": (3, 6), "contact_correlation": (7, 10), "misfit": (6, 7)}


async def app(_, receive, send):
    contact = touch.predict(orjson.loads((await receive())["body"])["inputs"][0]["data"])
    rows = [(name, contact[start:stop]) for name, (start, stop) in OUTPUTS.items()]
    outputs = [{"name": name, "datatype": "FP32", "shape": [1, len(row)], "data": row} for name, row in rows]
    answer = orjson.dumps({"model_name": touch.metadata.name, "model_version": "1", "outputs": outputs})
    headers = [(b"content-type", b"application/json"), (b"content-length", b"%d" % len(answer))]
    await send({"type": "http.response.start", "status": 200, "headers": headers})
    await send({"type": "http.response.body", "body": answer})


if __name__ == "__main__":
    uvicorn.run(app, port=int(sys.argv[2]), http="httptools", lifespan="off", access_log=False, log_level="critical")
