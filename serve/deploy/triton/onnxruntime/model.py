"""A backend `onnxruntime` for Triton, in Python: runs the `model.onnx` of a version as it stands.

Triton's own backend of this name is a library, which its containers have and the wheel `nvidia-pytriton` has not. Put
this folder into Triton's folder of backends, beside `python`; the configuration of a model needs no word about it.
"""

import json
from pathlib import Path

import onnxruntime as ort
import triton_python_backend_utils as pb_utils


class TritonPythonModel:
    """One version of one model."""

    @staticmethod
    def auto_complete_config(config):
        """The configuration as it is: `config.pbtxt` says everything."""
        return config

    def initialize(self, args):
        """Open the session: one thread, as a press takes microseconds."""
        options = ort.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        path = Path(args["model_repository"], args["model_version"], "model.onnx")
        self._session = ort.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        (self._input,) = (tensor["name"] for tensor in json.loads(args["model_config"])["input"])

    def execute(self, requests):
        """One response for each request; what fails is the answer to that request alone."""
        return [self._respond(request) for request in requests]

    def _respond(self, request):
        names = list(request.requested_output_names())
        try:
            charges = pb_utils.get_input_tensor_by_name(request, self._input).as_numpy()
            rows = self._session.run(names, {self._input: charges})
        except Exception as error:  # onnxruntime's exceptions have no common base of their own
            return pb_utils.InferenceResponse(error=pb_utils.TritonError(str(error)))
        return pb_utils.InferenceResponse([pb_utils.Tensor(*of) for of in zip(names, rows, strict=True)])
