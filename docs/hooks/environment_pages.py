"""`<!-- environment ID -->` in a page becomes the docstring of that environment (Gymnasium's headings), with its spaces
and its table of rewards from the code."""

import inspect
import re
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

MARK = re.compile(r"<!-- environment (\S+) -->")
HEADINGS = (
    *("Description", "Action Space", "Observation Space", "Rewards", "Starting State", "Episode End"),
    *("Info", "Arguments", "Version History"),
)


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Fill the marks in."""
    return MARK.sub(lambda mark: environment_text(mark[1]), markdown)


def environment_text(id: str) -> str:
    """What is told of an environment, as Markdown.

    Raises:
        PluginError: a docstring without one of the headings, or with others; names them.
    """
    summary, told = sections(environment_class(id).__doc__ or "")
    if tuple(told) != HEADINGS:
        raise PluginError(f"{id}: the docstring has the headings {', '.join(told)}; it must have {', '.join(HEADINGS)}")
    told["Rewards"] += "\n\n" + reward_table(told["Rewards"])
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


def sections(docstring: str) -> tuple[str, dict[str, str]]:
    """The summary of a docstring, and the text under each of its headings."""
    summary, *parts = re.split(r"^## (.+)$", inspect.cleandoc(docstring), flags=re.MULTILINE)
    return summary.strip(), {title.strip(): text.strip() for title, text in zip(parts[::2], parts[1::2])}


def reward_table(section: str) -> str:
    """Terms, weights and what they are for, from the table of surgsim_env/rewards.py that the section names."""
    from surgsim_env import rewards

    (name,) = re.findall(r"surgsim_env\.rewards\.(\w+)", section)
    weights: dict[str, float] = getattr(rewards, name)
    source = inspect.getsource(rewards)
    table = source[source.index(f"{name}:") :].partition("\n}")[0]
    comments = dict(re.findall(r'^\s+"(\w+)": [^#\n]*# (.+)$', table, flags=re.MULTILINE))
    rows = [f"| `{term}` | {weight:g} | {comments[term]} |" for term, weight in weights.items()]
    return "\n".join(["| term | weight | times |", "|---|---:|---|", *rows])


def summary_table(id: str) -> str:
    """What Gymnasium's registry and the environment itself say."""
    import gymnasium as gym

    env: Any = gym.make(id)
    spec, inner = gym.spec(id), env.unwrapped
    observed = env.observation_space
    limit = f"{spec.max_episode_steps} control steps" if spec.max_episode_steps else f"{inner.task.budget} presses"
    rows = {
        "action space": f"`{env.action_space}`",
        "observation space": f"`Box({observed.shape}, {observed.dtype})`, finite",
        "longest episode": limit,
        "by default": f"scene `{inner.scene.name}`, instrument `{inner.scene.instrument.model}`",
    }
    env.close()
    return "\n".join(["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows.items())])


def _lists_apart(text: str) -> str:
    """Markdown wants an empty line before a list or a table that follows a paragraph; 6-8 stays on one line."""
    apart = re.sub(r"^(?![*|\s])(.+)\n(?=[*|])", r"\1\n\n", text, flags=re.MULTILINE)
    return re.sub(r"^\| (\(?\d+)-(\d+\)?) \|", "| \\1\N{NON-BREAKING HYPHEN}\\2 |", apart, flags=re.MULTILINE)
