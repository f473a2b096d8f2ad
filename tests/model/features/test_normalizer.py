"""Running statistics against their definition."""

import copy

import pytest
import torch

from hood.model.features.normalizer import FixedScale, RunningNormalizer, Whitening


def calls(count: int = 7) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return [3.0 + 2.0 * torch.randn(5 + i, 4, generator=generator) for i in range(count)]


@pytest.mark.parametrize("decay", [0.9, 0.5, 1.0])
def test_statistics_are_the_exponentially_weighted_moments(decay):
    normalizer, data = RunningNormalizer(4, decay), calls()
    for x in data:
        normalizer(x)
    weights = torch.tensor([decay ** (len(data) - 1 - t) for t in range(len(data))], dtype=torch.float64)
    weights /= weights.sum()
    mean = sum(w * x.double().mean(0) for w, x in zip(weights, data, strict=True))
    square = sum(w * x.double().square().mean(0) for w, x in zip(weights, data, strict=True))
    expected = (data[0] - mean) / (square - mean**2).sqrt()
    torch.testing.assert_close(normalizer.eval()(data[0]), expected.float())


def test_plain_sums_weigh_every_row_alike():
    normalizer, data = RunningNormalizer(4, 0.0), calls()
    for x in data:
        normalizer(x)
    rows = torch.cat(data).double()
    mean, std = normalizer.statistics(torch.float64)
    torch.testing.assert_close(mean, rows.mean(0))
    torch.testing.assert_close(std, rows.std(0, correction=0))
    assert float(normalizer.weight) == len(rows)
    assert int(normalizer.num_updates) == len(data)


def test_first_call_is_standardised_by_itself():
    x = calls(1)[0]
    y = RunningNormalizer(4)(x)
    torch.testing.assert_close(y.mean(0), torch.zeros(4), atol=1e-6, rtol=0)
    torch.testing.assert_close(y.std(0, correction=0), torch.ones(4), atol=1e-5, rtol=0)


def test_inverse_undoes_forward():
    normalizer, x = RunningNormalizer(4), calls(1)[0]
    torch.testing.assert_close(normalizer.inverse(normalizer(x)), x)


def test_nothing_accumulates_in_evaluation_frozen_or_without_rows():
    normalizer, x = RunningNormalizer(4), calls(1)[0]
    normalizer.eval()(x)
    assert normalizer.num_updates == 0
    normalizer.train()(x[:0])
    assert normalizer.num_updates == 0
    normalizer(x)
    normalizer.freeze()
    before = normalizer.statistics(torch.float64)
    normalizer(x + 100)
    for a, b in zip(before, normalizer.statistics(torch.float64), strict=True):
        assert torch.equal(a, b)


def test_masked_rows_are_not_counted_but_are_normalised():
    x = calls(1)[0]
    spoiled = torch.cat([x, torch.full((3, 4), 1e6)])
    mask = torch.arange(len(spoiled)) < len(x)
    masked, plain = RunningNormalizer(4), RunningNormalizer(4)
    torch.testing.assert_close(masked(spoiled, mask)[: len(x)], plain(x))


def test_the_leading_columns_of_a_wider_table():
    """Counted and standardised as a table of their own; the others stay."""
    whole, alone = RunningNormalizer(3), RunningNormalizer(3)
    table = torch.randn(50, 5, generator=torch.Generator().manual_seed(0))
    expected = torch.cat([alone(table[:, :3]), table[:, 3:]], dim=1)
    assert torch.equal(whole.leading(table.clone()), expected)
    for name, value in alone.state_dict().items():
        assert torch.equal(whole.state_dict()[name], value)
    whole.eval()
    again = whole.leading(table.clone())
    assert torch.equal(again, expected)
    assert int(whole.num_updates) == 1


def test_identity_until_enough_calls():
    normalizer, x = RunningNormalizer(4, min_updates=2), calls(1)[0]
    assert torch.equal(normalizer(x), x)
    assert not torch.equal(normalizer(x), x)


def test_constant_channel_is_centred_only():
    normalizer = RunningNormalizer(1)
    normalizer(torch.full((50, 1), 1 / 30))
    assert normalizer.eval()(torch.tensor([[1 / 3]])).item() == pytest.approx(0.3)


def test_state_dict_restores_statistics_and_freeze():
    first, second, x = RunningNormalizer(4), RunningNormalizer(4), calls(1)[0]
    first(x)
    first.freeze()
    second.load_state_dict(first.state_dict())
    assert torch.equal(second(x), first(x))
    assert second.num_updates == 1


def test_sums_stay_in_double_precision_when_the_model_is_cast():
    normalizer = RunningNormalizer(4)
    normalizer(calls(1)[0])
    before = normalizer.first.clone()
    assert torch.equal(normalizer.half().first, before)


def test_given_statistics_are_used_from_then_on():
    normalizer = RunningNormalizer(2)
    normalizer.set_statistics(torch.tensor([1.0, 2.0]), torch.tensor([2.0, 4.0]))
    torch.testing.assert_close(normalizer(torch.tensor([[3.0, 10.0]])), torch.tensor([[1.0, 2.0]]))


def test_bad_settings_are_refused():
    with pytest.raises(ValueError, match="decay is 1.5"):
        RunningNormalizer(3, decay=1.5)
    with pytest.raises(ValueError, match="fixed scale"):
        FixedScale(0.0)


def test_fixed_scale_and_its_inverse():
    x = torch.tensor([[0.5, -20.0]])
    for asinh in (False, True):
        scale = FixedScale([0.5, 2.0], asinh)
        torch.testing.assert_close(scale.inverse(scale(x)), x)
    torch.testing.assert_close(FixedScale(0.5)(x), torch.tensor([[1.0, -40.0]]))


def test_divisor_floor_divides_constant_channels_too():
    normalizer = RunningNormalizer(2, decay=1.0, divisor_floor=1e-3)
    normalizer(torch.tensor([[1.0, 5.0], [3.0, 5.0]]))
    expected = torch.tensor([[1.0, 1000.0]])
    torch.testing.assert_close(normalizer.eval()(torch.tensor([[3.0, 6.0]])), expected)
    with pytest.raises(ValueError, match="divisor_floor"):
        RunningNormalizer(2, divisor_floor=0.0)


def like_an_edge(count: int, seed: int) -> torch.Tensor:
    """Two columns that are nearly one, and a third that is not to be white."""
    rows = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed))
    return torch.cat([rows[:, :1] + 0.5, rows[:, :1] + 0.5 + 0.05 * rows[:, 1:2], rows[:, 2:]], dim=1)


@pytest.mark.parametrize("optimizer", [torch.optim.Adam, torch.optim.SGD])
def test_a_layer_is_trained_as_if_it_saw_white_columns(optimizer):
    """Another layer sees them: u = T (x - mean), its weights begin where those of the first did."""
    torch.manual_seed(0)
    layer = torch.nn.Linear(3, 4)
    twin = copy.deepcopy(layer)
    seen, network = like_an_edge(1000, 1), torch.nn.Sequential(layer)
    whitening = Whitening({"mesh": layer}, {"mesh": "mesh"}, {"mesh": 2})
    whitening.count({"mesh": seen})
    with whitening.around(network, collecting=False):
        pass
    places = seen[:, :2].double()
    values, directions = torch.linalg.eigh(torch.cov(places.T, correction=0))
    assert float(values[0].sqrt()) < 0.05 < 1.0 < float(values[1].sqrt())
    whiten = directions @ torch.diag(values.rsqrt()) @ directions.T

    def white(x):
        return torch.cat([(x[:, :2].double() - places.mean(dim=0)) @ whiten, x[:, 2:]], dim=1).float()

    torch.testing.assert_close(torch.cov(white(seen)[:, :2].T, correction=0), torch.eye(2), atol=1e-5, rtol=0)
    first, second = optimizer(layer.parameters(), 0.01), optimizer(twin.parameters(), 0.01)
    for step in range(30):
        x = like_an_edge(50, 10 + step)
        target = (x[:, 1:2] - x[:, :1]) * torch.tensor([20.0, -10.0, 5.0, 1.0])
        for to, given in ((layer, x), (twin, white(x))):
            to.zero_grad()
            (to(given) - target).square().mean().backward()
        whitening.pull()
        whitening.push(first)
        second.step()
        torch.testing.assert_close(layer(x), twin(white(x)), atol=2e-5, rtol=0)


def test_trained_layers_are_left_as_they_are_until_their_first_update():
    torch.manual_seed(0)
    layer = torch.nn.Linear(3, 4)
    before = copy.deepcopy(layer.state_dict())
    whitening = Whitening({"mesh": layer}, {"mesh": "mesh"}, {"mesh": 2}, fresh=False)
    whitening.count({"mesh": like_an_edge(1000, 1)})
    with whitening.around(layer, collecting=False):
        pass
    assert all(torch.equal(value, before[name]) for name, value in layer.state_dict().items())
    assert set(whitening.state_dict()["bases"]) == {"mesh"}


def test_fewer_rows_than_columns_leave_the_updates_as_they_are():
    layers = {name: torch.nn.Linear(3, 4) for name in ("mesh", "body")}
    whitening = Whitening(layers, {"mesh": "mesh", "body": "body"}, {"mesh": 2, "body": 2})
    whitening.count({"mesh": like_an_edge(100, 1), "body": torch.zeros(0, 3)})
    with whitening.around(layers["mesh"], collecting=False):
        pass
    assert set(whitening.state_dict()["bases"]) == {"mesh"}


def test_nothing_is_counted_after_an_evaluation_that_failed():
    network = torch.nn.Linear(3, 4)
    whitening = Whitening({"mesh": network}, {"mesh": "mesh"}, {"mesh": 2})
    with pytest.raises(RuntimeError, match="no"), whitening.around(network, collecting=True):
        raise RuntimeError("no")
    assert not network._forward_pre_hooks
