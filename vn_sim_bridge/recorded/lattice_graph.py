"""The graph of states and actions: what can be reached from one another, and costs to a goal."""

from __future__ import annotations

import numba
import numpy as np

NO_WAY = 2**16 - 1  # the cost of states that have no way to the goal


@numba.njit(cache=True)
def components(to):
    """[S] number of each state's strongly connected component (Tarjan 1972, without recursion)."""
    count, actions = to.shape
    number = np.full(count, -1, np.int32)
    index = np.full(count, -1, np.int32)
    low = np.zeros(count, np.int32)
    path = np.empty(count, np.int32)  # states whose component is not known yet
    calls = np.empty(count, np.int32)
    action = np.zeros(count, np.int32)  # that is looked at next
    on_path = np.zeros(count, np.bool_)
    seen, found, length = 0, 0, 0
    for root in range(count):
        if index[root] >= 0:
            continue
        depth = 0
        calls[0] = root
        while depth >= 0:
            v = calls[depth]
            if index[v] < 0:
                index[v] = low[v] = seen
                seen += 1
                path[length] = v
                length += 1
                on_path[v] = True
            deeper = False
            while action[v] < actions:
                w = to[v, action[v]]
                if index[w] < 0:
                    depth += 1
                    calls[depth] = w
                    deeper = True
                    break
                if on_path[w]:
                    low[v] = min(low[v], low[w])
                action[v] += 1
            if deeper:
                continue
            if low[v] == index[v]:
                while True:
                    length -= 1
                    w = path[length]
                    on_path[w] = False
                    number[w] = found
                    if w == v:
                        break
                found += 1
            depth -= 1
            if depth >= 0:
                parent = calls[depth]
                low[parent] = min(low[parent], low[v])
                action[parent] += 1
    return number


@numba.njit(cache=True)
def costs_to(there, first, source, cost, count):
    """Costs of the ways to some states, by label correction over a queue."""
    costs = np.full(count, NO_WAY, np.uint16)
    queue = np.empty(count + 1, np.int32)
    waiting = np.zeros(count, np.bool_)
    head, tail = 0, 0
    for state in there:
        costs[state] = 0
        queue[tail] = state
        waiting[state] = True
        tail += 1
    while head != tail:
        state = queue[head]
        head = (head + 1) % len(queue)
        waiting[state] = False
        for k in range(first[state], first[state + 1]):
            before, value = source[k], np.int64(costs[state]) + cost[k]
            if value < costs[before]:
                costs[before] = value
                if not waiting[before]:
                    waiting[before] = True
                    queue[tail] = before
                    tail = (tail + 1) % len(queue)
    return costs
