"""The network alone: its two forms, what an output depends on, and a peer made of torch's own layers."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from lifting.model import NetworkConfig, TemporalNetwork

WHICH = pytest.mark.parametrize("causal", [False, True])


def network(widths: tuple[int, ...] = (3, 3, 3), causal: bool = False) -> TemporalNetwork:
    torch.manual_seed(0)
    net = TemporalNetwork(NetworkConfig(7, 4, 5, widths, channels=32, causal=causal))
    for _ in range(3):  # running statistics away from 0 and 1
        net.train()(torch.randn(4, 60, 7) * 2 + 1, torch.randn(4, 4) - 1)
    return net.eval()


@pytest.mark.parametrize(("widths", "frames"), [((3, 3, 3), 27), ((3, 5), 15), ((1,), 1), ((3,), 3)])
def test_the_receptive_field_is_the_product_of_the_filter_widths(
    widths: tuple[int, ...], frames: int
) -> None:
    assert network(widths).receptive_field() == frames
    assert network(widths).estimated() == frames // 2
    assert network(widths, causal=True).estimated() == frames - 1


@WHICH
@pytest.mark.parametrize("widths", [(3, 3, 3), (3, 5), (5, 3, 3)])
def test_strided_and_dilated_forms_agree(widths: tuple[int, ...], causal: bool) -> None:
    net = network(widths, causal)
    field = net.receptive_field()
    sequence, constants = torch.randn(2, field + 20, 7), torch.randn(2, 4)
    windows = sequence.unfold(1, field, 1).transpose(2, 3)
    strided = net.forward_windows(windows.flatten(0, 1), constants.repeat_interleave(21, dim=0))
    torch.testing.assert_close(net(sequence, constants), strided.reshape(2, 21, 5), atol=1e-5, rtol=0)


@WHICH
def test_an_output_depends_on_every_frame_of_its_window_and_on_no_other(causal: bool) -> None:
    net = network(causal=causal)
    sequence = torch.randn(1, 40, 7, requires_grad=True)
    output = net(sequence, torch.randn(1, 4))
    (gradient,) = torch.autograd.grad(output[0, 5].sum(), sequence)
    touched = gradient[0].abs().sum(dim=1) > 0
    assert touched.nonzero().flatten().tolist() == list(range(5, 5 + 27))


def test_of_a_causal_network_the_last_frame_of_the_window_goes_straight_through() -> None:
    """With temporal layers that say nothing, the answer is a function of the estimated frame alone."""
    for causal in (False, True):
        net = TemporalNetwork(NetworkConfig(7, 4, 5, (1, 3, 3), channels=32, causal=causal)).eval()
        with torch.no_grad():
            for layer in net.pointwise:
                layer.norm.weight.zero_()
        sequence = torch.randn(1, 30, 7, requires_grad=True)
        (gradient,) = torch.autograd.grad(net(sequence, torch.zeros(1, 4))[0, 3].sum(), sequence)
        touched = (gradient[0].abs().sum(dim=1) > 0).nonzero().flatten().tolist()
        assert touched == [3 + net.estimated()]
        windows = sequence[:, 3:12]
        (gradient,) = torch.autograd.grad(net.forward_windows(windows, torch.zeros(1, 4)).sum(), sequence)
        assert (gradient[0].abs().sum(dim=1) > 0).nonzero().flatten().tolist() == touched


@WHICH
def test_later_frames_do_not_change_what_was_answered(causal: bool) -> None:
    """Up to frame 40, of which the causal network says something and the other does not yet."""
    net = network(causal=causal)
    sequence, constants = torch.randn(1, 60, 7), torch.randn(1, 4)
    later = sequence.clone()
    later[:, 41:] = torch.randn(1, 19, 7)
    at = torch.arange(60 - 26) + net.estimated()
    here, there = net(sequence, constants)[0], net(later, constants)[0]
    same = (here - there).abs().amax(dim=1) == 0
    assert at[same].max() == (40 if causal else 40 - 13)
    window = slice(40 - 26, 41)
    assert torch.equal(
        net.forward_windows(sequence[:, window], constants), net.forward_windows(later[:, window], constants)
    )


@WHICH
def test_the_dilated_form_is_torchs_own_dilated_convolution(causal: bool) -> None:
    net = network(causal=causal)
    x, constants = torch.randn(2, 33, 7), torch.randn(2, 4)

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
    peer = net.shrink(y.transpose(1, 2))
    torch.testing.assert_close(net(x, constants), peer, atol=1e-5, rtol=1e-5)


def test_constants_are_features_that_every_frame_has() -> None:
    """A network whose frames carry the constants themselves is the same function."""
    net = network()
    whole = TemporalNetwork(NetworkConfig(11, 1, 5, channels=32)).eval()
    state = net.state_dict()
    frames = state["expand.linear.weight"].unflatten(1, (3, 7))
    each = state["constant.weight"][:, None].expand(32, 3, 4) / 3
    state["expand.linear.weight"] = torch.cat([frames, each], dim=2).flatten(1)
    state["constant.weight"] = torch.zeros(32, 1)
    whole.load_state_dict(state)
    x, constants = torch.randn(2, 30, 7), torch.randn(2, 4)
    wide = torch.cat([x, constants[:, None].expand(2, 30, 4)], dim=2)
    torch.testing.assert_close(net(x, constants), whole(wide, torch.zeros(2, 1)), atol=1e-5, rtol=0)
    assert (net(x, constants) - net(x, constants + 1)).abs().max() > 1e-3


def test_windows_of_another_length_are_refused() -> None:
    with pytest.raises(ValueError, match="windows of 26 frames; this network sees 27"):
        network().forward_windows(torch.zeros(1, 26, 7), torch.zeros(1, 4))
