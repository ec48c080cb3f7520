"""TripoSR at its published size with random weights: seconds per stage and peak memory.

    python -m benchmarks.triposr [--dtype bfloat16] [--resolution 256]

Prints the rows of the page benchmarks/results/triposr_cpu_2_cores.md.

The mesh means nothing; shapes, time and memory do. Times include compilation, as one photo on a fresh process does.
"""

import argparse
import json
import platform
import resource
import time


def main() -> None:
    """Run each stage once, with a line as it ends, and print one JSON object at the end."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dtype", default="float32", choices=("float32", "bfloat16"))
    parser.add_argument("--resolution", type=int, default=256)
    arguments = parser.parse_args()

    import jax
    import jax.numpy as jnp
    import numpy as np
    from flax import nnx

    from ipjax.networks.triposr.config import TripoSRConfig
    from ipjax.networks.triposr.field import density_grid, query
    from ipjax.networks.triposr.model import TripoSR, prepare_image
    from ipjax.onboarding.reconstruction.triposr import find_surface

    seconds: dict[str, float] = {}
    start = last = time.perf_counter()

    def peak() -> float:
        unit = 1 if platform.system() == "Darwin" else 1024
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9

    def done(stage: str) -> None:
        nonlocal last
        now = time.perf_counter()
        seconds[stage] = round(now - last, 2)
        last = now
        print(f"{stage}: {seconds[stage]:.1f} s, peak {peak():.2f} GB", flush=True)

    config = TripoSRConfig(dtype=arguments.dtype)
    model = TripoSR(config, rngs=nnx.Rngs(0))
    jax.block_until_ready(nnx.state(model))
    done("weights (random)")
    photo = jnp.asarray(np.random.default_rng(0).random((600, 600, 3), dtype=np.float32))
    image = prepare_image(photo, config.image_size)
    tokens = nnx.jit(lambda tokenizer, image: tokenizer(image))(model.tokenizer, image).block_until_ready()
    done("image tokenizer")
    backbone = nnx.jit(lambda model, tokens: model.unfold(model.backbone(model.tokens(), tokens)))
    triplane = backbone(model, tokens).block_until_ready()
    done("backbone and up-sampling")
    slabs = min(16, arguments.resolution)
    run = nnx.jit(lambda m, t, at: density_grid(m, t, arguments.resolution, start=at, count=slabs))
    parts = []
    for at in range(0, arguments.resolution, slabs):
        parts.append(np.asarray(run(model, triplane, jnp.int32(min(at, arguments.resolution - slabs)))))
        print(f"  density: {min(at + slabs, arguments.resolution)} of {arguments.resolution} slabs", flush=True)
    grid = np.concatenate(parts)[: arguments.resolution]
    done("density grid")
    # Random weights have no surface at the published threshold: take the value that a hundredth of the grid exceeds.
    vertices, _ = find_surface(grid, float(np.quantile(grid, 0.99)), config.radius)
    done("surface")
    points = jnp.asarray(vertices[: 1 << 16], jnp.float32)
    jax.block_until_ready(nnx.jit(lambda m, t, p: query(m, t, p, chunk=1 << 14))(model, triplane, points))
    done("colour of 65 536 points")
    print(
        json.dumps(
            {
                "device": jax.devices()[0].device_kind,
                "dtype": arguments.dtype,
                "resolution": arguments.resolution,
                "triplane": list(triplane.shape),
                "vertices": len(vertices),
                "seconds": seconds,
                "total_s": round(time.perf_counter() - start, 1),
                "peak_gb": round(peak(), 2),
            }
        )
    )


if __name__ == "__main__":
    main()
