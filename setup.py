"""Packages of the distribution; everything else is in pyproject.toml.

``models/`` has the scenes and recordings of ``pbrl-ppl new --from``. It is installed as
``pbrl_ppl/models``; ``[tool.setuptools.packages.find]`` cannot express that.
"""

from setuptools import find_packages, setup

setup(
    packages=[*find_packages(include=["pbrl_ppl", "pbrl_ppl.*"]), "pbrl_ppl.models"],
    package_dir={"pbrl_ppl.models": "models"},
)
