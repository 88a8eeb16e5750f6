"""`<!-- environment ID -->` in a page becomes the docstring of that environment (Gymnasium's headings), whose tables of
commands, channels and rewards come from the task's declaration; its spaces are added."""

import re
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

MARK = re.compile(r"<!-- environment (\S+) -->")


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Fill the marks in."""
    return MARK.sub(lambda mark: environment_text(mark[1]), markdown)


def environment_text(id: str) -> str:
    """The documentation of an environment as Markdown.

    Raises:
        PluginError: a docstring without one of the headings, or with others; names them.
    """
    from surgsim_env.tasks.declaration import HEADINGS, docstring_sections

    summary, told = docstring_sections(environment_class(id).__doc__ or "")
    if tuple(told) != HEADINGS:
        raise PluginError(f"{id}: the docstring has the headings {', '.join(told)}; it must have {', '.join(HEADINGS)}")
    make = f'```python\nimport gymnasium as gym\nimport surgsim_env\n\nenv = gym.make("{id}")\n```'
    parts = [make, summary_table(id), *(f"## {title}\n\n{_lists_apart(text)}" for title, text in told.items())]
    return "\n\n".join([summary, *parts])


def environment_class(id: str) -> type:
    """The class that an id makes."""
    import gymnasium as gym
    from gymnasium.envs.registration import load_env_creator

    import surgsim_env  # noqa: F401  (registers the ids)

    entry = gym.spec(id).entry_point
    assert isinstance(entry, str)
    creator = load_env_creator(entry)
    assert isinstance(creator, type)
    return creator


def summary_table(id: str) -> str:
    """What Gymnasium's registry and the environment itself say."""
    import gymnasium as gym

    env: Any = gym.make(id)
    spec, inner = gym.spec(id), env.unwrapped
    observed = env.observation_space
    limit = f"{spec.max_episode_steps} control steps" if spec.max_episode_steps else f"{inner.task.budget} presses"
    channels = ", ".join(
        f"`{name}` {part.start}" + (f"\N{NON-BREAKING HYPHEN}{part.stop - 1}" if part.stop > part.start + 1 else "")
        for name, part in inner.observation_slices.items()
    )
    rows = {
        "action space": f"`{env.action_space}`",
        "observation space": f"`Box({observed.shape}, {observed.dtype})`, finite",
        "entries of its channels": channels,
        "longest episode": limit,
        "by default": f"scene `{inner.scene.name}`, instrument `{inner.scene.instrument.model}`",
    }
    env.close()
    return "\n".join(["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows.items())])


def _lists_apart(text: str) -> str:
    """Markdown wants an empty line before a list or a table that follows a paragraph; 6-8 stays on one line."""
    apart = re.sub(r"^(?![*|\s])(.+)\n(?=[*|])", r"\1\n\n", text, flags=re.MULTILINE)
    return re.sub(r"^\| (\(?\d+)-(\d+\)?) \|", "| \\1\N{NON-BREAKING HYPHEN}\\2 |", apart, flags=re.MULTILINE)
