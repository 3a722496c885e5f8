// What the other C++ of this folder builds on: loops that the lanes of a warp share, barriers, and vectors. It is the
// beginning of the body of functions that are handed to Warp, so its types are local to them.
//
// On a GPU the lanes are a warp; on a CPU there is one lane, or there are fibers, where Warp's `enable_cpu_blocks` is
// set.

// A loop that the lanes share; not unrolled, for a kernel of few registers that fits a GPU's instruction cache.
#define SHARE(i, from, to) WP_PRAGMA_NO_UNROLL for (int i = (from) + lane; i < (to); i += LANES)

enum { LANES = WP_TILE_BLOCK_DIM };

struct Lanes {
    const int lane;

    CUDA_CALLABLE void sync() const
    {
#if defined(__CUDA_ARCH__)
        __syncwarp();
#else
        WP_TILE_SYNC();
#endif
    }
};

struct Vector {
    float x, y, z;

    static CUDA_CALLABLE Vector of(const float* p) { return { p[0], p[1], p[2] }; }

    CUDA_CALLABLE Vector operator+(const Vector& o) const { return { x + o.x, y + o.y, z + o.z }; }

    CUDA_CALLABLE Vector operator-(const Vector& o) const { return { x - o.x, y - o.y, z - o.z }; }

    CUDA_CALLABLE Vector operator*(float a) const { return { a * x, a * y, a * z }; }

    CUDA_CALLABLE float dot(const Vector& o) const { return x * o.x + y * o.y + z * o.z; }

    CUDA_CALLABLE float square() const { return dot(*this); }

    CUDA_CALLABLE Vector cross(const Vector& o) const
    {
        return { y * o.z - z * o.y, z * o.x - x * o.z, x * o.y - y * o.x };
    }

    CUDA_CALLABLE Vector unit() const
    {
        const float length = wp::sqrt(square());
        return *this * (length > 0.0f ? 1.0f / length : 0.0f);
    }

    CUDA_CALLABLE void to(float* p) const
    {
        p[0] = x;
        p[1] = y;
        p[2] = z;
    }

    // Write a frame [3, 3] whose first row this is, a unit vector: as by `make_frame` of MJX.
    CUDA_CALLABLE void frame(float* rows) const
    {
        const bool lies = -0.5f < y && y < 0.5f;
        const Vector up { 0.0f, lies ? 1.0f : 0.0f, lies ? 0.0f : 1.0f };
        const Vector second = (up - *this * dot(up)).unit();
        to(rows);
        second.to(rows + 3);
        cross(second).to(rows + 6);
    }
};

// Sine and cosine within a unit in the last place for some thousand turns (S. Moshier's Cephes); a GPU's own ones need
// local memory for larger angles.
struct Turn {
    float sine, cosine;

    CUDA_CALLABLE explicit Turn(float angle)
    {
        const float quarters = wp::floor(angle * 0.636619772f + 0.5f);
        const float r = (angle - quarters * 1.5703125f) - quarters * 4.83826794897e-4f, q = r * r;
        const float s = r + r * q * (-1.6666654611e-1f + q * (8.3321608736e-3f + q * -1.9515295891e-4f));
        const float even = 4.166664568298827e-2f + q * (-1.388731625493765e-3f + q * 2.443315711809948e-5f);
        const float c = 1.0f - 0.5f * q + q * q * even;
        const float quarter = quarters - 4.0f * wp::floor(0.25f * quarters);
        const bool swapped = quarter == 1.0f || quarter == 3.0f;
        sine = (quarter >= 2.0f ? -1.0f : 1.0f) * (swapped ? c : s);
        cosine = (quarter == 1.0f || quarter == 2.0f ? -1.0f : 1.0f) * (swapped ? s : c);
    }
};
