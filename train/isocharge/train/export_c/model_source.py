"""`isocharge_model.h`, `isocharge_model.c` and `self_test.c` of a model."""

from importlib import resources
from textwrap import indent

import numpy as np

from isocharge.serve import Contact
from isocharge.serve.model.golden import Golden
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.session import INPUT, OUTPUTS
from isocharge.train.export_c.c_text import c_array, c_comment, c_float, c_string, wrapped
from isocharge.train.export_c.graph import Graph
from isocharge.train.export_c.statements import NetworkSource

HEADER = """\
/* {label}: charges of a film to where and how hard it is touched. Written by isocharge train export-c. */
#ifndef ISOCHARGE_MODEL_H
#define ISOCHARGE_MODEL_H

#ifdef __cplusplus
extern "C" {{
#endif

#define ISOCHARGE_MODEL {model}
#define ISOCHARGE_SENSOR {sensor}
#define ISOCHARGE_ELECTRODES {count}
#define ISOCHARGE_ELECTRODE_NAMES {{{names}}}
#define ISOCHARGE_CONTACT_FIELDS {{{fields}}}

/* The contact of one press. It needs no memory but its stack, and may run on several threads at once.

   charge_pC  touch charges, pC, in the order of ISOCHARGE_ELECTRODE_NAMES. Any number may come: charges are taken as at
              least {low:g} and at most {high:g} pC, as in the ONNX file, and where one is NaN all answers are NaN.
   contact    x_mm, y_mm, force_N, their standard deviations x_std_mm, y_std_mm, force_std_N, and the misfit: distance
              of the charges from the nearest single contact that the model knows, in standard deviations. */
void isocharge_predict(const float charge_pC[ISOCHARGE_ELECTRODES], float contact[{width}]);

#ifdef __cplusplus
}}
#endif

#endif
"""


def model_header(metadata: ModelMetadata, graph: Graph) -> str:
    """The text of `isocharge_model.h`."""
    clip = next(node.constants for node in graph.nodes if node.operator == "Clip")
    return HEADER.format(
        label=c_comment(metadata.label),
        model=c_string(metadata.label),
        sensor=c_string(metadata.frame_id),
        count=len(metadata.electrodes),
        names=", ".join(map(c_string, metadata.electrodes)),
        fields=", ".join(map(plain_string, Contact._fields)),
        low=clip["low"],
        high=clip["high"],
        width=len(Contact._fields),
    )


def plain_string(name: str) -> str:
    """A name of ours as a C string."""
    return f'"{name}"'


def model_source(metadata: ModelMetadata, graph: Graph) -> str:
    """The text of `isocharge_model.c`."""
    network = NetworkSource.of(graph)
    arrays = ", ".join(f"{name}[{size}]" for name, size in network.arrays.items())
    body = "\n".join(network.statements)
    return "\n".join(
        [
            f"/* The network of {c_comment(metadata.label)} in single precision. "
            "Written by isocharge train export-c. */",
            '#include "isocharge_model.h"',
            "",
            "#include <math.h>",
            "",
            source_text("functions.c"),
            *network.definitions,
            f"void isocharge_predict(const float {INPUT}[ISOCHARGE_ELECTRODES], float contact[{len(Contact._fields)}])",
            "{",
            indent(f"float {arrays};\n\n{body}", "    ", lambda line: bool(line.strip())),
            "}",
            "",
        ]
    )


def self_test(golden: Golden) -> str:
    """The text of `self_test.c`: golden vectors, and how far an answer may be from them."""
    answers = np.concatenate([golden.outputs[name] for name in OUTPUTS], axis=1)
    floors = [floor for name in OUTPUTS for floor in golden.floors[name]]
    return "\n".join(
        [
            "/* Golden vectors of the model: exits with 0 if this machine answers as onnxruntime did. */",
            '#include "isocharge_model.h"',
            "",
            "#include <math.h>",
            "#include <stdio.h>",
            "",
            f"#define VECTORS {len(answers)}",
            f"#define RELATIVE {c_float(golden.relative)}",
            "",
            "/* |a - b| <= RELATIVE max(|b|, FLOOR) */",
            f"static const float FLOOR[{len(floors)}] = {{\n{wrapped(map(c_float, floors))}\n}};",
            "",
            c_array("float", "CHARGE_PC", golden.charge_pC),
            c_array("float", "CONTACT", answers),
            source_text("self_test.c"),
        ]
    )


def source_text(name: str) -> str:
    """A file of `sources/`."""
    return (resources.files(__package__) / "sources" / name).read_text("utf-8")
