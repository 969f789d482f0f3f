import subprocess
import sys

import pytest

COMMANDS = (
    *("collect", "import", "inspect", "finetune", "doctor", "export", "memorize", "rollout", "eval"),
    *("weights", "plugins", "recipes"),
)


def test_help_imports_no_torch():
    heavy = "print([name for name in ('torch', 'numpy', 'diffusers', 'pydantic') if name in sys.modules])"
    code = f"import sys\nfrom persist_cli.app import main\ntry: main(['--help'])\nexcept SystemExit: {heavy}"
    out = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    assert out.splitlines()[-1] == "[]"


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(persist, command):
    ended = persist(command, "--help")
    assert ended.code == 0
    assert "Usage" in ended.out


def test_the_version_is_the_packages(persist):
    from importlib.metadata import version

    assert persist("--version").out.strip() == f"persist {version('persist-cli')}"


def test_recipes_are_listed(persist):
    assert "tiny-stage2-voxel" in persist("recipes", "--json").out


def test_a_wrong_option_is_a_usage_error(persist):
    assert persist("collect", "--nonsense").code == 2
