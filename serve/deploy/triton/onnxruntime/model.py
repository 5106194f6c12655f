"""A backend for Triton, written in Python, with the name `onnxruntime`. The backend runs the `model.onnx` of a model.

The containers of Triton contain a library as the backend of this name, but the wheel `nvidia-pytriton` does not. The
folder of this file is copied into the folder of the backends of Triton, beside the folder `python`. The configuration
file of a model therefore needs no changes.
"""

import json
from pathlib import Path

import onnxruntime as ort
import triton_python_backend_utils as pb_utils


class TritonPythonModel:
    """One version of one model. Triton creates the object of this class and calls its methods."""

    @staticmethod
    def auto_complete_config(config):
        """Return the configuration unchanged, because `config.pbtxt` is complete."""
        return config

    def initialize(self, args):
        """Open a session of onnxruntime for the model. One thread is enough, because a press takes microseconds.

        Args:
            args: Folder of the model (`model_repository`), version and configuration, as Triton passes them by name.
        """
        options = ort.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # do not wait actively for work
        path = Path(args["model_repository"], args["model_version"], "model.onnx")
        self._session = ort.InferenceSession(path, options, providers=["CPUExecutionProvider"])

        model_config = json.loads(args["model_config"])
        (input_tensor,) = model_config["input"]  # every model has exactly one input, the charges
        self._input_name = input_tensor["name"]

    def execute(self, requests):
        """Return a response to each request. If a request fails, only its response contains the error."""
        return [self._respond(request) for request in requests]

    def _respond(self, request):
        """Run the model on the charges of a request. The response contains the requested outputs, or the error."""
        output_names = list(request.requested_output_names())
        try:
            charges = pb_utils.get_input_tensor_by_name(request, self._input_name).as_numpy()
            outputs = self._session.run(output_names, {self._input_name: charges})
        except Exception as error:  # onnxruntime's exceptions have no common base class of their own
            return pb_utils.InferenceResponse(error=pb_utils.TritonError(str(error)))

        tensors = [pb_utils.Tensor(name, values) for name, values in zip(output_names, outputs, strict=True)]
        return pb_utils.InferenceResponse(tensors)
