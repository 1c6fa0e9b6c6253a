// Calls gsplat's kernels, which stand before this text, as gsplat's host code does.
//
// VERSION: 140, 153, 160. Arrays are C-contiguous; a Fast is passed as a float.
#pragma once

#include <algorithm>
#include <vector>
#include <xmmintrin.h>

namespace {

// Subnormals count as zero, as with --use_fast_math (-ftz=true).
struct Flushed {
    unsigned before = _mm_getcsr();
    Flushed() {
        if (REAL_KIND == 2) _mm_setcsr(before | 0x8040);
    }
    ~Flushed() { _mm_setcsr(before); }
};

}  // namespace

extern "C" {

void set_noise(uint64_t seed, int kind) {
    noise.random.state = seed;
    noise.kind = kind;
    for (double &end : noise.ends) end = noise.random.next() & 1 ? 1.0 : -1.0;
}

// radii [n, 2], the other outputs of the projection kernel; `compensations` is null in classic mode.
void project(
    uint32_t n, const real *means, const real *quats, const real *scales, const real *opacities, const real *view,
    const real *intrinsics, uint32_t width, uint32_t height, int32_t *radii, real *means2d, real *depths, real *conics,
    real *compensations
) {
    using namespace gsplat;
    Flushed flushed;
    for (uint32_t k = 0; k < n; ++k) {
        grid_rank = k;
#if VERSION == 140
        fully_fused_projection_fwd_kernel<real>(
            1, n, means, nullptr, quats, scales, view, intrinsics, width, height, real(0.3), real(0.01), real(1e10),
            real(0.0), PINHOLE, radii, means2d, depths, conics, compensations
        );
#elif VERSION == 153
        projection_ewa_3dgs_fused_fwd_kernel<real>(
            1, 1, n, means, nullptr, quats, scales, opacities, view, intrinsics, width, height, real(0.3), real(0.01),
            real(1e10), real(0.0), PINHOLE, radii, means2d, depths, conics, compensations
        );
#else
        projection_ewa_3dgs_fused_fwd_kernel<real>(
            0, n, 1, 1, n, means, nullptr, quats, scales, opacities, view, intrinsics, width, height, real(0.3),
            real(0.01), real(1e10), real(0.0), PINHOLE, radii, means2d, depths, conics, compensations
        );
#endif
    }
#if VERSION == 140
    for (uint32_t k = n; k-- > 0;) radii[2 * k] = radii[2 * k + 1] = radii[k];
#endif
}

// Colours [n, 3] of spherical harmonics `coefficients` [n, bands, 3]. `eye` [3] is the camera's position; from 1.6.0
// on it follows from `view`.
void shade(
    uint32_t n, uint32_t bands, uint32_t degree, const real *means, const real *eye, const real *view,
    const real *coefficients, real *colors
) {
    using namespace gsplat;
    Flushed flushed;
    for (uint32_t k = 0; k < n; ++k) {
#if VERSION == 160
        const real_vec3 direction = view_direction_from_world_to_camera(means + 3 * k, view);
#else
        const real_vec3 direction(means[3 * k] - eye[0], means[3 * k + 1] - eye[1], means[3 * k + 2] - eye[2]);
#endif
        for (uint32_t c = 0; c < 3; ++c) {
            const real *own = coefficients + 3 * bands * k;
#if VERSION == 160
            sh_coeffs_to_color_fast<real>(degree, 3, c, direction, own, colors + 3 * k);
#else
            sh_coeffs_to_color_fast<real>(degree, c, direction, own, colors + 3 * k);
#endif
            colors[3 * k + c] = max(colors[3 * k + c] + real(0.5f), real(0.0f));
        }
    }
}

static void intersect(
    uint32_t n, const real *means2d, const int32_t *radii, const real *depths, const real *conics,
    const real *opacities, uint32_t tiles_x, uint32_t tiles_y, const int64_t *ends, int32_t *counts, int64_t *keys,
    int32_t *ids
) {
    using namespace gsplat;
    std::vector<int32_t> single(n);
    for (uint32_t k = 0; k < n; ++k) single[k] = radii[2 * k];
    for (uint32_t k = 0; k < n; ++k) {
        grid_rank = k;
#if VERSION == 140
        isect_tiles<real>(
            false, 1, n, 0, nullptr, nullptr, means2d, single.data(), depths, ends, 16,
            tiles_x, tiles_y, 32, counts, keys, ids
        );
#elif VERSION == 153
        intersect_tile_kernel<real>(
            false, 1, n, 0, nullptr, nullptr, means2d, radii, depths, ends, 16, tiles_x, tiles_y, 31, 1, counts, keys,
            ids
        );
#else
        intersect_tile_kernel<real>(
            0, n, false, 1, n, 0, nullptr, nullptr, means2d, radii, depths, conics, opacities, ends, 16, tiles_x,
            tiles_y, 31, 1, 0, int64_t(tiles_x) * tiles_y, nullptr, counts, keys, ids
        );
#endif
    }
}

// The second pass errs as the first one did: on the device, equal operands have equal results.
static Noise first_pass;

// Numbers of tiles of each Gaussian [n]; returns their sum.
int64_t count_tiles(
    uint32_t n, const real *means2d, const int32_t *radii, const real *depths, const real *conics,
    const real *opacities, uint32_t tiles_x, uint32_t tiles_y, int32_t *counts
) {
    Flushed flushed;
    first_pass = noise;
    intersect(n, means2d, radii, depths, conics, opacities, tiles_x, tiles_y, nullptr, counts, nullptr, nullptr);
    int64_t sum = 0;
    for (uint32_t k = 0; k < n; ++k) sum += counts[k];
    return sum;
}

// Gaussians by tile, front to back: `ids`, and where each tile's begin [tiles + 1]. To be called after `count_tiles`.
void fill_tiles(
    uint32_t n, const real *means2d, const int32_t *radii, const real *depths, const real *conics,
    const real *opacities, uint32_t tiles_x, uint32_t tiles_y, const int32_t *counts, int32_t *offsets, int32_t *ids
) {
    std::vector<int64_t> ends(n);
    int64_t sum = 0;
    for (uint32_t k = 0; k < n; ++k) ends[k] = sum += counts[k];
    std::vector<int64_t> keys(sum);
    std::vector<int32_t> unsorted(sum);
    {
        Flushed flushed;
        noise = first_pass;
        intersect(
            n, means2d, radii, depths, conics, opacities, tiles_x, tiles_y, ends.data(), nullptr, keys.data(),
            unsorted.data()
        );
    }
    std::vector<int64_t> order(sum);
    for (int64_t k = 0; k < sum; ++k) order[k] = k;
    // the radix sort of float keys is stable; a double's depth does not fit into the key
    std::stable_sort(order.begin(), order.end(), [&](int64_t a, int64_t b) {
        if (REAL_KIND != 0) return keys[a] < keys[b];
        const int64_t tile_a = keys[a] >> 32, tile_b = keys[b] >> 32;
        return tile_a != tile_b ? tile_a < tile_b : depths[unsorted[a]] < depths[unsorted[b]];
    });
    std::fill(offsets, offsets + int64_t(tiles_x) * tiles_y + 1, 0);
    for (int64_t k = 0; k < sum; ++k) {
        ids[k] = unsorted[order[k]];
        ++offsets[(keys[order[k]] >> 32) + 1];
    }
    for (int64_t k = 0; k < int64_t(tiles_x) * tiles_y; ++k) offsets[k + 1] += offsets[k];
}

// Colours [count, 3] without background and alphas [count] of pixels [count, 2] (row, column).
void rasterize(
    uint32_t n, const real *means2d, const real *conics, const real *colors, const real *opacities, uint32_t width,
    uint32_t height, uint32_t tiles_x, uint32_t tiles_y, int32_t *offsets, const int32_t *ids, int64_t count,
    const int64_t *pixels, real *out, real *alphas
) {
    using namespace gsplat;
    Flushed flushed;
    const int64_t size = int64_t(width) * height;
    std::vector<real> image(3 * size), alpha(size);
    std::vector<int32_t> last(size), own(size + 2);
    const int32_t total = offsets[int64_t(tiles_x) * tiles_y];
    for (int64_t k = 0; k < count; ++k) {
        const uint32_t row = pixels[2 * k], column = pixels[2 * k + 1];
        const int64_t at = int64_t(row) * width + column;
        const auto centers = (const real_vec2 *)means2d;
        const auto inverses = (const real_vec3 *)conics;
#if VERSION == 160
        // a tile of one pixel with the list of its own tile
        const uint32_t tile = row / 16 * tiles_x + column / 16;
        own[at] = offsets[tile];
        own[at + 1] = offsets[tile + 1];
        blockIdx = {uint32_t(at), 0, 0};
        threadIdx = {0, 0, 0};
        rasterize_to_pixels_3dgs_fwd_kernel<3, 1, 1>(
            n, own[at + 1], false, centers, inverses, colors, opacities, nullptr, nullptr, width, height, 1, width,
            height, 0, own.data(), ids, image.data(), alpha.data(), last.data()
        );
#else
        blockIdx = {0, row / 16, column / 16};
        threadIdx = {column % 16, row % 16, 0};
#if VERSION == 140
        rasterize_to_pixels_fwd_kernel<3, real>(
#else
        rasterize_to_pixels_3dgs_fwd_kernel<3, real>(
#endif
            1, n, total, false, centers, inverses, colors, opacities, nullptr, nullptr, width, height, 16, tiles_x,
            tiles_y, offsets, ids, image.data(), alpha.data(), last.data()
        );
#endif
        for (int c = 0; c < 3; ++c) out[3 * k + c] = image[3 * at + c];
        alphas[k] = alpha[at];
    }
}

}  // extern "C"
