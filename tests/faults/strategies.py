"""Demonstrations that hypothesis draws: any size, units, type and ill luck."""

from dataclasses import replace

from hypothesis import strategies as st
from reliability.problems import (
    COLUMNS,
    DTYPES,
    GROUPS,
    INPUTS,
    LAYOUTS,
    OFFSETS,
    OUTPUTS,
    UNITS,
    Recipe,
)

SEEDS = st.integers(0, 2**32 - 1)


@st.composite
def recipes(draw, *, most_demos=20, most_steps=60, most_outputs=6, least_demos=1):
    """Recipes of demonstrations."""
    d, e = draw(st.integers(1, most_outputs)), draw(st.integers(1, 3))

    def each(values, n):
        return tuple(draw(st.sampled_from(values)) for _ in range(n))

    return Recipe(
        draw(SEEDS),
        draw(st.integers(least_demos, most_demos)),
        # Short ones are as telling, and fits of many rows take long.
        draw(st.one_of(st.integers(2, min(10, most_steps)), st.integers(2, most_steps))),
        d,
        e,
        draw(st.sampled_from(INPUTS)),
        each(COLUMNS, e),
        each(OUTPUTS, d),
        each(UNITS, e),
        each(UNITS, d),
        each(OFFSETS, e),
        each(OFFSETS, d),
        draw(st.integers(0, 3)),
        (draw(st.sampled_from(DTYPES[:-1])), draw(st.sampled_from(DTYPES))),
        each(LAYOUTS, 2),
        draw(st.sampled_from(GROUPS)),
    )


def movement_recipes(**sizes):
    """Recipes of recordings for a controller: two or more, of five samples or more."""
    return recipes(least_demos=2, **sizes).map(lambda recipe: replace(recipe, n_steps=max(8, recipe.n_steps)))
