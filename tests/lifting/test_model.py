"""The network alone: what an output depends on, and a peer made of torch's own convolutions."""

from __future__ import annotations

import lifting_support as support
import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional

from lifting.model import FoldedNetwork, NetworkConfig
from lifting.training.network import TemporalNetwork
from lifting.windows import mirror_features, mirror_output

CAUSAL = pytest.mark.parametrize("causal", [False, True])


def trained(widths: tuple[int, ...] = (3, 3, 3), causal: bool = False) -> TemporalNetwork:
    torch.manual_seed(0)
    net = TemporalNetwork(NetworkConfig(7, 4, 5, widths, channels=32, causal=causal))
    for _ in range(3):  # running statistics away from 0 and 1
        net.train()(torch.randn(40, net.config.receptive_field(), 7) * 2 + 1, torch.randn(40, 4) - 1)
    return net.eval()


@CAUSAL
def test_the_strided_form_is_torchs_dilated_convolution(causal: bool) -> None:
    net = trained(causal=causal)
    x, constants = torch.randn(2, 27, 7), torch.randn(2, 4)

    def convolve(layer: torch.nn.Module, x: Tensor, dilation: int, shift: Tensor | float) -> Tensor:
        weight = layer.linear.weight.unflatten(1, (-1, x.shape[1])).transpose(1, 2)
        y = functional.conv1d(x, weight, dilation=dilation) + shift
        norm = layer.norm
        y = functional.batch_norm(y, norm.running_mean, norm.running_var, norm.weight, norm.bias)
        return torch.relu(y)

    shift = (constants @ net.constant.weight.T)[:, :, None]
    y = convolve(net.expand, x.transpose(1, 2), 1, shift)
    for dilation, temporal, pointwise in zip((3, 9), net.temporal, net.pointwise, strict=True):
        inner = convolve(temporal, y, dilation, 0.0)
        kept = y[:, :, 2 * dilation :] if causal else y[:, :, dilation:-dilation]
        y = kept + convolve(pointwise, inner, 1, 0.0)
    peer = net.shrink(y.transpose(1, 2))[:, 0]
    torch.testing.assert_close(net(x, constants), peer, atol=1e-5, rtol=1e-5)
    assert (net(x, constants) - net(x, constants + 1)).abs().max() > 1e-3


@pytest.mark.parametrize("flip", [True, False])
@pytest.mark.parametrize("causal", [True, False])
@pytest.mark.parametrize("table", [support.TABLE, support.TABLE_17])
def test_output_is_that_of_the_network(flip: bool, causal: bool, table: object) -> None:
    lifter = support.untrained_lifter(table=table, causal=causal)
    body, config, generator = lifter.description.body, lifter.description.network, torch.Generator().manual_seed(1)
    for name, value in lifter.weights.items():
        if name.endswith(("running_mean", "running_var")):  # away from 0 and 1
            value += 0.5 + torch.rand(value.shape, generator=generator).numpy() - name.endswith("var")
    network = support.network_of(lifter)
    assert {name: value.shape for name, value in lifter.weights.items()} == config.weight_shapes()
    for batch in (1, 5):
        features = torch.randn(batch, 27, config.inputs, generator=generator)
        constants = torch.randn(batch, config.constants, generator=generator)
        with torch.no_grad():
            wanted = network(features, constants)
            if flip:
                mirrored = network(mirror_features(body, features), constants)
                wanted = (wanted + mirror_output(body, mirrored)) / 2
        found = FoldedNetwork(body, config, lifter.weights, flip)(features.numpy(), constants.numpy())
        assert found.dtype == np.float32
        np.testing.assert_allclose(found, wanted, atol=2e-5, rtol=1e-5)
