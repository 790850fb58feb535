"""The four losses of a level, and their sum over levels.

Every function takes voxels as rows: (log-)`probabilities` f32 or f64 [V, K] and `labels` i64 [V] in 0..K; ignored voxels
must have been dropped. All results are scalars in natural logarithms, of the precision of the input.
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


def focal(log_probabilities: Tensor, labels: Tensor, weights: Tensor | None = None) -> Tensor:
    """Mean over voxels of -w_c (1 - p)^2 log p, p being the probability of the labelled class c (arXiv 1708.02002).

    The sum is divided by the number of voxels, not by the sum of their weights `weights` [K] (all 1 by default).
    """
    log_p = log_probabilities.gather(1, labels.unsqueeze(1)).squeeze(1)
    loss = -((1.0 - log_p.exp()) ** GAMMA) * log_p
    if weights is not None:
        loss = loss * weights[labels]
    return loss.mean()


def lovasz_softmax(probabilities: Tensor, labels: Tensor, right: Tensor | None = None) -> Tensor:
    """Lovasz-softmax (arXiv 1705.08790): mean over the classes that occur of the Lovasz extension of 1 - IoU.

    For class c the errors |[label = c] - p_c| are sorted downwards; each is weighted by the growth of the Jaccard loss when
    its voxel joins the wrong ones. `right` [K] counts voxels of each class that were left out because they have hardly
    any error: they belong to the union and stand at the end of every order.
    """
    classes = probabilities.shape[1]
    count = torch.bincount(labels, minlength=classes).to(probabilities.dtype)
    if right is not None:
        count = count + right
    present = count.nonzero().squeeze(1)
    truth = labels == present.unsqueeze(1)
    errors = (truth.to(probabilities.dtype) - probabilities.t()[present]).abs()
    errors, order = errors.sort(dim=1, descending=True)
    truth = truth.gather(1, order).to(errors.dtype)
    total = count[present].unsqueeze(1)
    intersection = total - truth.cumsum(1)
    union = total + (1.0 - truth).cumsum(1)
    jaccard = 1.0 - intersection / union
    growth = torch.cat((jaccard[:, :1], jaccard[:, 1:] - jaccard[:, :-1]), 1)
    return (errors * growth).sum(1).mean()


SURE = 0.98
"""A voxel whose labelled class has at least this probability is right: no class has an error above 1 - SURE there."""


def lovasz_softmax_of_some(probabilities: Tensor, labels: Tensor, voxels: int) -> Tensor:
    """Lovasz-softmax of the voxels that matter, at most about so many: sorting all would take longer than the network.

    Voxels that are right are only counted. Of the others, `voxels` are drawn if there are more, and the counts shrink in
    proportion.
    """
    p = probabilities.detach().gather(1, labels.unsqueeze(1)).squeeze(1)
    open_ones = (p < SURE).nonzero().squeeze(1)
    right = torch.bincount(labels, minlength=probabilities.shape[1]) - torch.bincount(
        labels[open_ones], minlength=probabilities.shape[1]
    )
    right = right.to(probabilities.dtype)
    if len(open_ones) > voxels:
        right = right * (voxels / len(open_ones))
        open_ones = open_ones[torch.randint(len(open_ones), (voxels,), device=labels.device)]
    return lovasz_softmax(probabilities[open_ones], labels[open_ones], right)


def negative_log(numerator: Tensor, denominator: Tensor) -> Tensor:
    """-log(numerator / denominator), at most MAX_LOG; 0 where the denominator is 0 and there is nothing to measure."""
    ratio = numerator / torch.where(denominator > 0, denominator, torch.ones_like(denominator))
    # A ratio of 0 has the cut-off value and no gradient; rounding may push a ratio of 1 just above it.
    floor = torch.finfo(torch.float32).tiny
    value = torch.where(ratio > floor, -ratio.clamp(floor, 1.0).log(), torch.full_like(ratio, MAX_LOG)).clamp(max=MAX_LOG)
    return torch.where(denominator > 0, value, torch.zeros_like(value))


def geometric_affinity(probabilities: Tensor, labels: Tensor) -> Tensor:
    """Geometric scene-class affinity (arXiv 2112.00726): -log of precision, recall and specificity of "occupied"."""
    occupied = (labels != 0).to(probabilities.dtype)
    p = 1.0 - probabilities[:, 0]
    both = (p * occupied).sum()
    neither = ((1.0 - p) * (1.0 - occupied)).sum()
    precision = negative_log(both, p.sum())
    recall = negative_log(both, occupied.sum())
    specificity = negative_log(neither, (1.0 - occupied).sum())
    return precision + recall + specificity


def semantic_affinity(probabilities: Tensor, labels: Tensor) -> Tensor:
    """Semantic scene-class affinity (arXiv 2112.00726): -log of precision, recall and specificity of every class that
    occurs in `labels` (the empty class 0 too), summed, over the number of such classes."""
    voxels, classes = probabilities.shape
    count = torch.bincount(labels, minlength=classes).to(probabilities.dtype)
    mass = probabilities.sum(0)
    both = torch.zeros_like(mass).index_add(0, labels, probabilities.gather(1, labels.unsqueeze(1)).squeeze(1))
    # sum over the other voxels of 1 - p_c
    neither = (voxels - count) - (mass - both)
    terms = negative_log(both, mass) + negative_log(both, count) + negative_log(neither, voxels - count)
    present = count > 0
    return terms[present].sum() / present.sum()


def level_losses(logits: Tensor, labels: Tensor, weights: Tensor | None = None, lovasz_voxels: int = 0) -> dict:
    """The four losses of one level by name.

    `logits` [..., K], `labels` [...] with IGNORED allowed. Lovasz-softmax sees all voxels if `lovasz_voxels` is 0, otherwise
    at most so many (`lovasz_softmax_of_some`); the other losses see all.
    """
    logits = logits.reshape(-1, logits.shape[-1])
    if logits.dtype != torch.float64:
        logits = logits.float()
    labels = labels.reshape(-1).long()
    counted = labels != IGNORED
    if not bool(counted.all()):
        logits, labels = logits[counted], labels[counted]
    if len(labels) == 0:
        zero = logits.sum() * 0.0
        return {"focal": zero, "lovasz": zero, "geometric": zero, "semantic": zero}
    log_probabilities = F.log_softmax(logits, 1)
    probabilities = log_probabilities.exp()
    if 0 < lovasz_voxels < len(labels):
        lovasz = lovasz_softmax_of_some(probabilities, labels, lovasz_voxels)
    else:
        lovasz = lovasz_softmax(probabilities, labels)
    return {
        "focal": focal(log_probabilities, labels, weights),
        "lovasz": lovasz,
        "geometric": geometric_affinity(probabilities, labels),
        "semantic": semantic_affinity(probabilities, labels),
    }


def pooled_labels(labels: Tensor, classes: int) -> list:
    """Labels u8 [..., X, Y, Z] of level 0 -> those of levels 0 to 3, each half as wide.

    A coarse voxel has the most frequent occupied class of its 8, 64 or 512 voxels of level 0, the lower class on a tie;
    it is empty where none is occupied, and ignored where all are ignored.
    """
    counts = F.one_hot(torch.where(labels == IGNORED, classes, labels).long(), classes + 1)[..., :classes].int()
    levels = [labels]
    for _ in range(3):
        *lead, x, y, z, _ = counts.shape
        counts = counts.reshape(-1, x // 2, 2, y // 2, 2, z // 2, 2, classes).sum((2, 4, 6))
        counts = counts.reshape(*lead, x // 2, y // 2, z // 2, classes)
        occupied = counts[..., 1:]
        label = torch.where(occupied.sum(-1) > 0, occupied.argmax(-1) + 1, 0)
        levels.append(torch.where(counts.sum(-1) > 0, label, IGNORED).to(torch.uint8))
    return levels
