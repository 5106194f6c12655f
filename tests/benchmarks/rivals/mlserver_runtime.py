"""MLServer's way: a custom runtime around the same session; `bench_http.py` writes its settings and starts it."""

import numpy as np
import onnxruntime as ort
from mlserver import MLModel
from mlserver.codecs import NumpyCodec
from mlserver.types import InferenceRequest, InferenceResponse


class Runtime(MLModel):
    async def load(self) -> bool:
        options = ort.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        path = self.settings.parameters.uri
        self.session = ort.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        self.names = [output.name for output in self.session.get_outputs()]
        return True

    async def predict(self, payload: InferenceRequest) -> InferenceResponse:
        charges = NumpyCodec.decode_input(payload.inputs[0]).astype(np.float32, copy=False)
        rows = self.session.run(None, {"charge_pC": charges})
        outputs = [NumpyCodec.encode_output(name, row) for name, row in zip(self.names, rows, strict=True)]
        return InferenceResponse(model_name=self.name, model_version="1", outputs=outputs)
