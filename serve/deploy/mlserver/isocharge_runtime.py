"""MLServer's way to run a `model.onnx`: a custom runtime around an ONNX session."""

import numpy as np
import onnxruntime as ort
from mlserver import MLModel
from mlserver.codecs import NumpyCodec
from mlserver.types import InferenceRequest, InferenceResponse


class OnnxRuntime(MLModel):
    """One version of one model; `parameters.uri` is its file."""

    async def load(self) -> bool:
        """Open the session: one thread, as a press takes microseconds."""
        options = ort.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        path = self.settings.parameters.uri
        self.session = ort.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        self.names = [output.name for output in self.session.get_outputs()]
        return True

    async def predict(self, payload: InferenceRequest) -> InferenceResponse:
        """All outputs of the model."""
        charges = NumpyCodec.decode_input(payload.inputs[0]).astype(np.float32, copy=False)
        rows = self.session.run(None, {payload.inputs[0].name: charges})
        outputs = [NumpyCodec.encode_output(name, row) for name, row in zip(self.names, rows, strict=True)]
        return InferenceResponse(model_name=self.name, model_version=self.version, outputs=outputs)
