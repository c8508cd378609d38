"""Dead-ends, attention states and staying actions: searches on the graph against fixed points."""

from hypothesis import given

from checks import library_model, plain
from ssp_lp.model import graph
from strategies import often, problems


@often(200)
@given(problems())
def test_graph_facts_are_the_fixed_points(drawn):
    """The masks name the states that the plain fixed points name."""
    model, reference = library_model(drawn), plain(drawn)
    dead, attention = graph.dead_ends(model), graph.attention_states(model)
    for state in drawn.choices:
        position = model.index_of(state)
        assert dead[position] == (state in reference.dead_ends), state
        assert attention[position] == (state in reference.attention), state
    assert not dead[model.goal_mask].any()
    assert not attention[model.goal_mask].any()


@often(100)
@given(problems())
def test_attention_pairs_keep_to_the_attention_states(drawn):
    """The staying actions of each attention state."""
    model, reference = library_model(drawn), plain(drawn)
    staying = graph.attention_pairs(model, graph.attention_states(model))
    for state in drawn.choices:
        position = model.index_of(state)
        pairs = range(model.pair_offsets[position], model.pair_offsets[position + 1])
        found = [model.action_of(pair) for pair in pairs if staying[pair]]
        listed = reference.staying(state) if state in reference.attention else []
        assert found == listed
