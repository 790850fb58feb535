"""The four losses of a level, and their sum over levels.

Every function takes voxels as rows: (log-)`probabilities` f32 or f64 [V, K], `labels` i64 [V] in 0..K and `counted`
[V], 1 for a voxel that counts and 0 for one that is ignored (all count by default). All results are scalars in natural
logarithms, of the precision of the input. No shape depends on a value, and nothing waits for the device, so that a step can be
recorded and replayed (`train.py`).
"""

import torch
import torch.nn.functional as F
from torch import Tensor

IGNORED = 255
"""Label of a voxel that no loss and no metric counts."""

LEVEL_WEIGHTS = (1.0, 0.5, 0.25, 0.125)
"""Weights of levels 0 to 3."""

GAMMA = 2.0

MAX_LOG = 100.0
"""-log is cut off here, as PyTorch's binary cross-entropy does."""


def one_hot(labels: Tensor, classes: int) -> Tensor:
    """bool [V, K]."""
    return labels.unsqueeze(1) == torch.arange(classes, device=labels.device)


def focal(log_probabilities: Tensor, labels: Tensor, weights: Tensor | None = None, counted: Tensor | None = None) -> Tensor:
    """Mean over voxels of -w_c (1 - p)^2 log p, p being the probability of the labelled class c (arXiv 1708.02002).

    The sum is divided by the number of voxels, not by the sum of their weights `weights` [K] (all 1 by default).
    """
    log_p = log_probabilities.gather(1, labels.unsqueeze(1)).squeeze(1)
    loss = -((1.0 - log_p.exp()) ** GAMMA) * log_p
    if weights is not None:
        loss = loss * weights[labels]
    if counted is None:
        return loss.mean()
    return (loss * counted).sum() / counted.sum().clamp(min=1)


def lovasz_softmax(probabilities: Tensor, labels: Tensor, right: Tensor | None = None, counted: Tensor | None = None) -> Tensor:
    """Lovasz-softmax (arXiv 1705.08790): mean over the classes that occur of the Lovasz extension of 1 - IoU.

    For class c the errors |[label = c] - p_c| are sorted downwards; each is weighted by the growth of the Jaccard loss when
    its voxel joins the wrong ones. `right` [K] counts voxels of each class that were left out because they have hardly
    any error: they belong to the union and stand at the end of every order. So do ignored voxels, whose error is 0.
    """
    truth = one_hot(labels, probabilities.shape[1])
    if counted is not None:
        truth = truth & (counted > 0).unsqueeze(1)
    truth = truth.t().to(probabilities.dtype)
    count = truth.sum(1)
    if right is not None:
        count = count + right
    errors = (truth - probabilities.t()).abs()
    if counted is not None:
        errors = errors * counted
    errors, order = errors.sort(dim=1, descending=True)
    truth = truth.gather(1, order)
    total = count.unsqueeze(1)
    intersection = total - truth.cumsum(1)
    union = total + (1.0 - truth).cumsum(1)
    jaccard = 1.0 - intersection / union
    growth = torch.cat((jaccard[:, :1], jaccard[:, 1:] - jaccard[:, :-1]), 1)
    present = (count > 0).to(errors.dtype)
    return ((errors * growth).sum(1) * present).sum() / present.sum().clamp(min=1)


SURE = 0.98
"""A voxel whose labelled class has at least this probability is right: no class has an error above 1 - SURE there."""


def lovasz_softmax_of_some(probabilities: Tensor, labels: Tensor, voxels: int, counted: Tensor | None = None) -> Tensor:
    """Lovasz-softmax of the voxels that matter, at most about so many: sorting all would take longer than the network.

    Voxels that are right are only counted. Of the others, `voxels` are drawn if there are more, and the counts shrink in
    proportion.
    """
    p = probabilities.detach().gather(1, labels.unsqueeze(1)).squeeze(1)
    unsure = p < SURE
    sure = ~unsure if counted is None else ~unsure & (counted > 0)
    if counted is not None:
        unsure = unsure & (counted > 0)
    right = (one_hot(labels, probabilities.shape[1]) & sure.unsqueeze(1)).sum(0).to(probabilities.dtype)
    # The n-th unsure voxel is the first with n of them up to it.
    ranks = unsure.cumsum(0)
    found = ranks[-1]
    every = torch.arange(1, voxels + 1, device=labels.device)
    drawn = (torch.rand(voxels, device=labels.device) * found).long() + 1
    wanted = torch.where(found > voxels, drawn.minimum(found), every)
    chosen = torch.searchsorted(ranks, wanted).clamp(max=len(labels) - 1)
    right = right * (voxels / found.clamp(min=1)).clamp(max=1.0).to(right.dtype)
    return lovasz_softmax(probabilities[chosen], labels[chosen], right, (wanted <= found).to(probabilities.dtype))


def negative_log(numerator: Tensor, denominator: Tensor) -> Tensor:
    """-log(numerator / denominator), at most MAX_LOG; 0 where the denominator is 0 and there is nothing to measure."""
    ratio = numerator / torch.where(denominator > 0, denominator, torch.ones_like(denominator))
    # A ratio of 0 has the cut-off value and no gradient; rounding may push a ratio of 1 just above it.
    floor = torch.finfo(torch.float32).tiny
    value = torch.where(ratio > floor, -ratio.clamp(floor, 1.0).log(), torch.full_like(ratio, MAX_LOG)).clamp(max=MAX_LOG)
    return torch.where(denominator > 0, value, torch.zeros_like(value))


def geometric_affinity(probabilities: Tensor, labels: Tensor, counted: Tensor | None = None) -> Tensor:
    """Geometric scene-class affinity (arXiv 2112.00726): -log of precision, recall and specificity of "occupied"."""
    occupied = (labels != 0).to(probabilities.dtype)
    empty = 1.0 - occupied
    p = 1.0 - probabilities[:, 0]
    if counted is not None:
        occupied, empty, p = occupied * counted, empty * counted, p * counted
    both = (p * occupied).sum()
    neither = ((1.0 - p) * empty).sum()
    precision = negative_log(both, p.sum())
    recall = negative_log(both, occupied.sum())
    specificity = negative_log(neither, empty.sum())
    return precision + recall + specificity


def semantic_affinity(probabilities: Tensor, labels: Tensor, counted: Tensor | None = None) -> Tensor:
    """Semantic scene-class affinity (arXiv 2112.00726): -log of precision, recall and specificity of every class that
    occurs in `labels` (the empty class 0 too), summed, over the number of such classes."""
    truth = one_hot(labels, probabilities.shape[1]).to(probabilities.dtype)
    if counted is not None:
        truth, probabilities = truth * counted.unsqueeze(1), probabilities * counted.unsqueeze(1)
    voxels = truth.sum()
    count, mass = truth.sum(0), probabilities.sum(0)
    both = (truth * probabilities).sum(0)
    # sum over the other voxels of 1 - p_c
    neither = (voxels - count) - (mass - both)
    terms = negative_log(both, mass) + negative_log(both, count) + negative_log(neither, voxels - count)
    present = (count > 0).to(terms.dtype)
    return (terms * present).sum() / present.sum().clamp(min=1)


def level_losses(logits: Tensor, labels: Tensor, weights: Tensor | None = None, lovasz_voxels: int = 0) -> dict:
    """The four losses of one level by name.

    `logits` [..., K], `labels` [...] with IGNORED allowed. Lovasz-softmax sees all voxels if `lovasz_voxels` is 0, otherwise
    at most so many (`lovasz_softmax_of_some`); the other losses see all. All are 0 where every voxel is ignored.
    """
    logits = logits.reshape(-1, logits.shape[-1])
    if logits.dtype != torch.float64:
        logits = logits.float()
    labels = labels.reshape(-1).long()
    counted = (labels != IGNORED).to(logits.dtype)
    labels = torch.where(labels == IGNORED, 0, labels)
    log_probabilities = F.log_softmax(logits, 1)
    probabilities = log_probabilities.exp()
    if 0 < lovasz_voxels < len(labels):
        lovasz = lovasz_softmax_of_some(probabilities, labels, lovasz_voxels, counted)
    else:
        lovasz = lovasz_softmax(probabilities, labels, counted=counted)
    return {
        "focal": focal(log_probabilities, labels, weights, counted),
        "lovasz": lovasz,
        "geometric": geometric_affinity(probabilities, labels, counted),
        "semantic": semantic_affinity(probabilities, labels, counted),
    }


def pooled_labels(labels: Tensor, classes: int) -> list:
    """Labels u8 [..., X, Y, Z] of level 0 -> those of levels 0 to 3, each half as wide.

    A coarse voxel has the most frequent occupied class of its 8, 64 or 512 voxels of level 0, the lower class on a tie;
    it is empty where none is occupied, and ignored where all are ignored.
    """
    counts = (labels.unsqueeze(-1) == torch.arange(classes, device=labels.device)).to(torch.int16)
    levels = [labels]
    for _ in range(3):
        *lead, x, y, z, _ = counts.shape
        counts = counts.reshape(-1, x // 2, 2, y // 2, 2, z // 2, 2, classes).sum((2, 4, 6), dtype=torch.int16)
        counts = counts.reshape(*lead, x // 2, y // 2, z // 2, classes)
        occupied = counts[..., 1:]
        label = torch.where(occupied.sum(-1) > 0, occupied.argmax(-1) + 1, 0)
        levels.append(torch.where(counts.sum(-1) > 0, label, IGNORED).to(torch.uint8))
    return levels
