"""Memory of the published-type model as it is planned for: no weights, no GPU, no allocation.

    python bench/published_memory.py

Prints the table of docs/research/published.md. Gigabytes are 10^9 bytes; see `mudg/diffusion/published.py` for what
is counted.
"""

import sys

from mudg.diffusion import published
from mudg.diffusion.published import PublishedConfig

CUTS = (
    ("all at once", 6),
    ("modalities together, guidance apart", 3),
    ("guidance together, modalities apart", 2),
    ("one by one", 1),
)
BUDGETS_GB = (8, 10, 16, 24, 40, 80)


def report(needs: published.Needs) -> list[str]:
    """What each way of cutting the work takes, and what is chosen for some budgets."""
    lines = [f"  condition, latents and images of a clip {needs.clip / 1e9:19.2f} GB"]
    for label, batch in CUTS:
        total = needs.parameters + needs.clip + needs.one_video * batch + published.RESERVE_BYTES
        lines.append(f"  denoising, {label:<36}{needs.one_video * batch / 1e9:7.2f} GB, in all {total / 1e9:6.2f} GB")
    for frames in published.FRAMES_AT_ONCE:
        lines.append(f"  autoencoder, {frames:2d} frames at once {needs.one_frame * frames / 1e9:24.2f} GB")
    for budget in BUDGETS_GB:
        plan, peak_bytes = published.choose(needs, budget * 10**9)
        way = [f"modalities {'together' if plan.modalities_together else 'apart'}"]
        way += [
            f"guidance {'together' if plan.guidance_together else 'apart'}",
            f"{plan.frames_at_once} frames per decoding",
        ]
        fits = "" if peak_bytes <= budget * 1e9 else "  (does not fit)"
        lines.append(f"  budget {budget:2d} GB: {', '.join(way):<80}{peak_bytes / 1e9:5.1f} GB{fits}")
    return lines


def main() -> None:
    """Print."""
    for bytes_per_value, name in ((2, "bfloat16"), (4, "float32")):
        for height, width in ((320, 512), (576, 1024)):
            needs = published.needs_of(PublishedConfig(height=height, width=width), bytes_per_value)
            title = f"{height}x{width}x16, {name}: weights {needs.parameters / 1e9:.2f} GB"
            sys.stdout.write("\n".join([title, *report(needs)]) + "\n")


if __name__ == "__main__":
    main()
