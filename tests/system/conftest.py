"""What the searches over all commands that write share: a folder that their lines name, and a server that runs them."""

from __future__ import annotations

from pathlib import Path

import pytest
from kill_server import KillServer
from writing_commands import write_work


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the lines name."""
    folder = tmp_path_factory.mktemp("work")
    write_work(folder)
    return folder


@pytest.fixture
def server() -> KillServer:
    return KillServer.shared()
