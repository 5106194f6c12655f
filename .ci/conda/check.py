"""Check the conda recipe: rattler-build reads it and renders it with the versions of conda-forge.

python .ci/conda/check.py    (in an environment with the package py-rattler-build)
"""

from pathlib import Path

from rattler_build import Stage0Recipe, VariantConfig

recipe = Stage0Recipe.from_file(Path(__file__).with_name("recipe.yaml"))
(variant,) = recipe.render(VariantConfig({"python_min": ["3.11"]}))
rendered = variant.recipe.to_dict()
print(rendered["package"], *rendered["requirements"]["run"], sep="\n")
