"""Skeleton of a metric: how much brighter a view is than the truth (docs/extend/metric.md)."""

from mudg.core.metrics import MetricRow, Pair, frame_mean


def brightness_bias(pair: Pair) -> float | None:
    """Mean of made minus true colours, in [-1, 1]; None where the view has no colours, or the truth is not known."""
    if pair.rgb is None or pair.truth_rgb is None:
        return None
    difference = pair.rgb - pair.truth_rgb  # f32[3, H, W]
    return float((difference if pair.mask is None else difference[:, pair.mask[0]]).double().mean())


# Title, unit, what a method must produce, which way is better, and how to build the accumulator.
ROW = MetricRow("brightness bias", "", ("rgb",), "lower", lambda: frame_mean(brightness_bias))
