# mujoco's compiled modules come without type information; to pyright everything in it is Any.
from typing import Any

def __getattr__(name: str) -> Any: ...
