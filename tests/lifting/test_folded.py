"""The inference form gives the output of the network."""

from __future__ import annotations

import lifting_support as support
import pytest
import torch

from lifting.models import FoldedNetwork, model_of
from lifting.predict import Lifter
from lifting.windows import EncodedWindows


def with_statistics(lifter: Lifter) -> Lifter:
    """A lifter with normalisation statistics away from 0 and 1."""
    generator = torch.Generator().manual_seed(0)
    for name, buffer in lifter.network.named_buffers():
        if name.endswith(("running_mean", "running_var")):
            buffer.copy_(0.5 + torch.rand(buffer.shape, generator=generator))
    return lifter


@pytest.mark.parametrize("flip", [True, False])
@pytest.mark.parametrize("causal", [True, False])
@pytest.mark.parametrize("table", [support.TABLE, support.TABLE_17])
def test_output_is_that_of_the_network(flip: bool, causal: bool, table: object) -> None:
    lifter = with_statistics(support.untrained_lifter(table=table, causal=causal))
    body, config = lifter.description.body, lifter.description.network
    generator = torch.Generator().manual_seed(1)
    for batch in (1, 5):
        features = torch.randn(batch, 27, config.inputs, generator=generator)
        constants = torch.randn(batch, config.constants, generator=generator)
        none = torch.zeros(batch, 3, 3)
        encoded = EncodedWindows(features, constants, none, none, none[:, 0, 0])
        with torch.inference_mode():
            wanted = model_of("rays").answer(body, lifter.network, encoded, flip)
            found = FoldedNetwork(body, lifter.network, flip)(features, constants)
        torch.testing.assert_close(found, wanted, atol=2e-5, rtol=1e-5)


def test_input_and_network_are_unchanged() -> None:
    lifter = support.untrained_lifter()
    config = lifter.description.network
    before = {name: value.clone() for name, value in lifter.network.state_dict().items()}
    features, constants = torch.randn(2, 27, config.inputs), torch.randn(2, config.constants)
    kept = features.clone()
    with torch.inference_mode():
        FoldedNetwork(lifter.description.body, lifter.network)(features, constants)
    assert torch.equal(features, kept)
    for name, value in lifter.network.state_dict().items():
        assert torch.equal(value, before[name])
