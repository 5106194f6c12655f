"""Activation functions of hidden layers, and the names of the functions in PyTorch, ONNX and C.

The dictionary `ACTIVATIONS` contains all activation functions. Training, the ONNX graph and the C
export look up the activation functions in this dictionary.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Activation:
    """Activation function that is applied to each output of a hidden layer.

    Attributes:
        name: Name of the activation function in configurations and files.
        torch_name: Name of the function in `torch.nn.functional`. The attribute is a text, and not the function itself,
            because only training needs PyTorch.
        onnx_operator: Name of the ONNX operator, which has one input, one output and no attributes.
        c_source: C99 source of the function `static float <c_function>(float x)`, in single precision.
    """

    name: str
    torch_name: str
    onnx_operator: str
    c_source: str

    @property
    def c_function(self) -> str:
        """Name of the function in C."""
        return f"{self.name}_of"


_TANH_C = """\
/* tanh within 4e-7 for every x, as x P(x^2) / Q(x^2); beyond +-9.02 it is +-1 in single precision. NaN gives NaN.
   Without branches, so that a compiler can work on several numbers at once. All terms have one sign: nothing\
 cancels. */
static float tanh_of(float x)
{
    const float bound = 9.02f;
    float square, p, q;

    x = x > bound ? bound : x;
    x = x < -bound ? -bound : x;
    square = x * x;
    p = 1.331876784e-8f;
    p = p * square + 2.058327738e-5f;
    p = p * square + 3.494022072e-3f;
    p = p * square + 1.337970746e-1f;
    p = p * square + 1.0f;
    q = 7.761905190e-7f;
    q = q * square + 3.283072452e-4f;
    q = q * square + 2.587102576e-2f;
    q = q * square + 4.671302270e-1f;
    q = q * square + 1.0f;
    return x * p / q;
}
"""

TANH = Activation("tanh", torch_name="tanh", onnx_operator="Tanh", c_source=_TANH_C)
"""Hyperbolic tangent, the activation of all released models."""

ACTIVATIONS = {activation.name: activation for activation in (TANH,)}
"""All activations of hidden layers, by name."""
