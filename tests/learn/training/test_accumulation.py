import torch
from lightning_fabric import Fabric
from torch import nn

from stereoweave.learn.training.accumulation import StepSums

FABRIC = Fabric(accelerator="cpu", devices=1)


def accumulated(network, batches):
    sums = StepSums(network)
    for batch in batches:
        network.zero_grad()
        loss = network(batch).sum()
        loss.backward()
        sums.add([loss, 2 * loss])
    return sums.finish(FABRIC, len(batches))


def test_losses_and_gradients_are_means_over_the_micro_batches():
    network = nn.Linear(1, 1, bias=False)
    nn.init.ones_(network.weight)
    # The losses 1, 4 and 7 are also the gradients.
    assert accumulated(network, [torch.full((1, 1), x) for x in (1.0, 4.0, 7.0)]) == [4.0, 8.0]
    assert network.weight.grad.item() == 4.0


def test_each_micro_batch_starts_from_the_same_statistics_and_their_mean_is_kept():
    network = nn.BatchNorm1d(1, momentum=0.5)
    with torch.no_grad():
        network.running_mean.fill_(8.0)
    # Batch means are 0 and 4. Halfway from 8, running means are 4 and 6; in sequence, they would end at 4.
    accumulated(network, [torch.tensor([[-1.0], [1.0]]), torch.tensor([[3.0], [5.0]])])
    assert network.running_mean.item() == 5.0
    # Halfway from 1 to the variance, 2.
    assert network.running_var.item() == 1.5
    assert network.num_batches_tracked.item() == 1


def test_a_sum_does_not_depend_on_its_order():
    """A sum in float32 would: 1 is lost beside 2^24."""
    network = nn.Linear(1, 1, bias=False)
    gradients = []
    for order in ((1.0, 2.0**24, 1.0, -(2.0**24)), (2.0**24, 1.0, -(2.0**24), 1.0)):
        accumulated(network, [torch.full((1, 1), x) for x in order])
        gradients.append(network.weight.grad.item())
    assert gradients == [0.5, 0.5]


def test_a_parameter_without_a_gradient_gets_none():
    network = nn.Sequential(nn.Linear(1, 1, bias=False), nn.Linear(1, 1))
    network[1].weight.requires_grad_(False)
    accumulated(network, [torch.ones(1, 1)])
    assert network[1].weight.grad is None
    assert network[1].bias.grad.item() == 1.0
