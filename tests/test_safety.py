"""No code from files: calls that would run what a user's file holds, by the package's source."""

import ast
from pathlib import Path

import pytest

import pbrl_ppl

pytestmark = pytest.mark.one_stack
PACKAGE = Path(pbrl_ppl.__file__).parent
#: Calls by their last name that run code, start a shell, or may do so in reading data.
RUN = {"eval", "exec", "compile", "system", "popen", "Popen",
       "__import__"}  # fmt: skip
READ = {"load", "loads", "Unpickler", "read_pickle", "unsafe_load", "full_load", "load_all"}
#: Modules whose ``load`` runs code.
UNSAFE = {"pickle", "cloudpickle", "dill", "joblib", "marshal", "shelve", "yaml", "torch"}
#: What is allowed, and why.
ALLOWED = {
    # an effect file is Python by design: its user names it with --effect-file, and the help and the
    # documentation say that it is run
    "cli/options.py: exec",
    "cli/options.py: compile",
    # a Python of its own compiles a loop of the package; nothing that is read reaches its code
    "physics/calls.py: subprocess.Popen",
}
#: Built-in `compile`, and not a method of this name.
BUILT_IN = {"eval", "exec", "compile", "__import__"}


def calls(path: Path):
    """Yield each call's name as it is written, with its keywords."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), {one.arg: ast.unparse(one.value) for one in node.keywords}


def risky(name: str, keywords: dict[str, str]) -> bool:
    """Return whether a call could run what a file holds."""
    module, _, last = name.rpartition(".")
    top = module.partition(".")[0]
    return (
        (last in RUN and (not module or last not in BUILT_IN) and top in {"", "os", "subprocess"})
        or (last in READ and top in UNSAFE)
        or last in {"read_pickle", "Unpickler"}
        or keywords.get("allow_pickle", "False") != "False"
        or keywords.get("shell", "False") != "False"
        or keywords.get("autoescape", "True") == "False"
    )


def test_no_call_runs_what_a_file_holds() -> None:
    """Neither pickle nor eval nor a shell, but where this file says why."""
    found = {
        f"{path.relative_to(PACKAGE).as_posix()}: {name}"
        for path in PACKAGE.rglob("*.py")
        for name, keywords in calls(path)
        if risky(name, keywords)
    }
    assert found == ALLOWED


def test_no_module_imports_what_only_unpickles_or_starts_programs() -> None:
    """The exceptions have their line above."""
    modules = {"pickle", "cloudpickle", "dill", "marshal", "shelve", "joblib", "subprocess", "yaml"}
    found = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [one.name for one in node.names] if isinstance(node, ast.Import) else []
            names += [str(node.module)] if isinstance(node, ast.ImportFrom) else []
            found |= {(path.name, name) for name in names if name.partition(".")[0] in modules}
    # SciPy and HDF5 do not survive some damaged files: a Python of its own reads them first
    read_apart, compiled_apart = ("files.py", "subprocess"), ("calls.py", "subprocess")
    assert found == {read_apart, compiled_apart}


@pytest.mark.parametrize(
    "call", ["eval(x)", "pickle.load(f)", "np.load(f, allow_pickle=True)", "os.system(x)",
             "subprocess.run(x, shell=True)", "yaml.load(f)", "pd.read_pickle(f)"],
)  # fmt: skip
def test_such_calls_are_found(tmp_path, call) -> None:
    """The test above would see each of them."""
    (tmp_path / "a.py").write_text(call)
    (found,) = calls(tmp_path / "a.py")
    assert risky(*found)


@pytest.mark.parametrize("call", ["re.compile(x)", "np.load(f)", "Scene.load(p)", "json.loads(t)"])
def test_ordinary_calls_pass(tmp_path, call) -> None:
    """Calls of the same name that run nothing."""
    (tmp_path / "a.py").write_text(call)
    (found,) = calls(tmp_path / "a.py")
    assert not risky(*found)
