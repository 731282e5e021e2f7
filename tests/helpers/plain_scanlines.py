"""Plain reference of `bench.classical.scanline_kernels`: each way carries its own disparities along."""


def plain_alignment(costs, occlusion_cost):
    """Return the disparities of the cheapest alignment of one row; costs are [W, D]."""
    width, count = costs.shape
    ways = {i: (0, ()) for i in range(count)}
    for x in range(width):
        after = {}
        for i in reversed(range(count)):
            cost, found = ways[i]
            choices = [(cost + int(costs[x, i]), (*found, i))]
            if i > 0:
                cost, found = ways[i - 1]
                choices.append((cost + occlusion_cost, (*found, -1)))
            if i + 1 in after:
                cost, found = after[i + 1]
                choices.append((cost + occlusion_cost, found))
            after[i] = min(choices, key=lambda choice: choice[0])
        ways = after
    return min((ways[i] for i in range(count)), key=lambda way: way[0])[1]
