from __future__ import annotations

import pytest
import torch
from torch.nn import functional

from lifting.model import NetworkConfig, TemporalNetwork


def network(widths: tuple[int, ...] = (3, 3, 3)) -> TemporalNetwork:
    torch.manual_seed(0)
    net = TemporalNetwork(NetworkConfig(7, 5, widths, channels=32))
    for _ in range(3):  # running statistics away from 0 and 1
        net.train()(torch.randn(4, 60, 7) * 2 + 1)
    return net.eval()


@pytest.mark.parametrize(("widths", "frames"), [((3, 3, 3), 27), ((3, 5), 15), ((1,), 1), ((3,), 3)])
def test_the_receptive_field_is_the_product_of_the_filter_widths(
    widths: tuple[int, ...], frames: int
) -> None:
    assert network(widths).receptive_field() == frames


@pytest.mark.parametrize("widths", [(3, 3, 3), (3, 5), (5, 3, 3)])
def test_strided_and_dilated_forms_agree(widths: tuple[int, ...]) -> None:
    net = network(widths)
    field = net.receptive_field()
    sequence = torch.randn(2, field + 20, 7)
    windows = sequence.unfold(1, field, 1).transpose(2, 3)
    strided = net.forward_windows(windows.flatten(0, 1)).reshape(2, 21, 5)
    torch.testing.assert_close(net(sequence), strided, atol=1e-5, rtol=0)


def test_an_output_depends_on_every_frame_of_its_window_and_on_no_other() -> None:
    net = network()
    sequence = torch.randn(1, 40, 7, requires_grad=True)
    (gradient,) = torch.autograd.grad(net(sequence)[0, 5].sum(), sequence)
    touched = gradient[0].abs().sum(dim=1) > 0
    assert touched.nonzero().flatten().tolist() == list(range(5, 5 + 27))


def test_the_dilated_form_is_torchs_own_dilated_convolution() -> None:
    net = network()
    x = torch.randn(2, 33, 7)

    def convolve(layer: torch.nn.Module, x: torch.Tensor, dilation: int) -> torch.Tensor:
        weight = layer.linear.weight.unflatten(1, (-1, x.shape[1])).transpose(1, 2)
        y = functional.conv1d(x, weight, dilation=dilation)
        norm = layer.norm
        y = functional.batch_norm(y, norm.running_mean, norm.running_var, norm.weight, norm.bias)
        return torch.relu(y)

    y = convolve(net.expand, x.transpose(1, 2), 1)
    for dilation, temporal, pointwise in zip((3, 9), net.temporal, net.pointwise, strict=True):
        inner = convolve(temporal, y, dilation)
        y = y[:, :, dilation:-dilation] + convolve(pointwise, inner, 1)
    peer = net.shrink(y.transpose(1, 2))
    torch.testing.assert_close(net(x), peer, atol=1e-5, rtol=1e-5)


def test_windows_of_another_length_are_refused() -> None:
    with pytest.raises(ValueError, match="windows of 26 frames; this network sees 27"):
        network().forward_windows(torch.zeros(1, 26, 7))
