// First part of the search for contacts of one pair of geoms, which builds on `lanes.h`: two prisms in world axes, and
// how far they are apart along the normals of their faces.
//
// Lanes only ever compare what they found, so the result has the same bits however many there are. The rules are those
// of `colliders.py`, and so are most names; repeated corners, faces and edges are left out.
//
// Python puts in front of this text: RING (corners of a ring), EACH (contacts of a pair), and the numbers of
// `colliders.py`.

enum { VERTICES = 2 * RING, FACES = RING + 2, EDGES = 3 * RING, POINTS = 4 * RING };

// The largest value so far and the first index that has it.
struct Best {
    float value;
    int index;

    CUDA_CALLABLE void offer(float other, int at)
    {
        if (other > value || (other == value && at < index)) {
            value = other;
            index = at;
        }
    }
};

// A prism of c distinct corners a ring. Vertices: lower ring, upper ring. Faces: c sides, lower cap, upper cap.
// Edges: lower ring, upper ring, c rises.
struct Hull {
    Vector vertex[VERTICES], normal[FACES];
    Vector direction[EDGES];  // unit vectors
    float side[EDGES][FACES];  // cross product of the normals of both faces, times the normals of the other hull
    int c;

    CUDA_CALLABLE int after(int k) const { return k + 1 < c ? k + 1 : 0; }

    CUDA_CALLABLE int size(int face) const { return face < c ? 4 : c; }

    // Corner j of a face, counter-clockwise from outside.
    CUDA_CALLABLE const Vector& corner(int face, int j) const
    {
        const int k = j == 0 || j == 3 ? face : after(face);
        return vertex[face < c ? k + (j < 2 ? 0 : c) : face == c ? c - 1 - j : c + j];
    }

    CUDA_CALLABLE const Vector& from(int e) const { return vertex[e < 2 * c ? e : e - 2 * c]; }

    CUDA_CALLABLE const Vector& to(int e) const
    {
        return vertex[e < c ? after(e) : e < 2 * c ? c + after(e - c) : e - c];
    }

    CUDA_CALLABLE int left(int e) const { return e < c ? e : e < 2 * c ? e - c : e > 2 * c ? e - 2 * c - 1 : c - 1; }

    CUDA_CALLABLE int right(int e) const { return e < c ? c : e < 2 * c ? c + 1 : e - 2 * c; }
};

// A geom of a pair: its hull, and how it stands.
struct Geom {
    const float *corners, *normals;  // [VERTICES, 3] and [FACES, 3], in its own frame
    const float* turn;  // [3, 3], from that to the world's
    Vector shift;  // metres, world
};

// What the lanes share.
struct PairMemory {
    Hull hull[2];
    Vector point[POINTS];  // candidates for contacts
    float height[POINTS];  // over the reference face, or the plane
    float value[LANES];
    int index[LANES];
    Vector where[EACH];  // of the contacts, metres, about the second geom
    float depth[EACH];  // of the contacts: below zero where there is one
};

struct Pair : Lanes {
    PairMemory& s;

    // The best of what all lanes bring.
    CUDA_CALLABLE Best best(Best mine) const
    {
#if defined(__CUDA_ARCH__)
        __syncwarp();  // so that what lanes wrote before is seen after it, as on the CPU
        for (int far = LANES / 2; far > 0; far /= 2)
            mine.offer(
                __shfl_xor_sync(0xffffffffu, mine.value, far), __shfl_xor_sync(0xffffffffu, mine.index, far)
            );
        return mine;
#else
        if (LANES == 1)
            return mine;
        s.value[lane] = mine.value;
        s.index[lane] = mine.index;
        sync();
        for (int i = 0; i < LANES; ++i)
            mine.offer(s.value[i], s.index[i]);
        sync();
        return mine;
#endif
    }

    // Put a hull into shared memory: turned by the matrix `turn`, then moved by `shift`.
    CUDA_CALLABLE void place(int which, const Geom& geom, const Vector& shift) const
    {
        Best last { -1.0f, 0 };  // the last corner that is no repetition of the one before it
        SHARE(k, 1, RING) {
            const float *p = geom.corners + 3 * k, *q = p - 3;
            last.offer(p[0] != q[0] || p[1] != q[1] || p[2] != q[2] ? 1.0f * k : -1.0f, k);
        }
        Hull& hull = s.hull[which];
        const int c = best(last).index + 1;
        const Vector x = Vector::of(geom.turn), y = Vector::of(geom.turn + 3), z = Vector::of(geom.turn + 6);
        SHARE(i, 0, 2 * c) {
            const Vector v = Vector::of(geom.corners + 3 * (i < c ? i : i - c + RING));
            hull.vertex[i] = Vector { x.dot(v), y.dot(v), z.dot(v) } + shift;
        }
        SHARE(f, 0, c + 2) {
            const Vector n = Vector::of(geom.normals + 3 * (f < c - 1 ? f : f - c + RING));
            hull.normal[f] = { x.dot(n), y.dot(n), z.dot(n) };
        }
        if (lane == 0)
            hull.c = c;
        sync();
    }

    // The face of either hull from which the other one is farthest (the least deep, where they overlap).
    CUDA_CALLABLE void face_gaps(Best& first, Best& second) const
    {
        const int c = s.hull[0].c;
        SHARE(i, 0, c + s.hull[1].c + 4) {
            const int which = i >= c + 2, f = which ? i - c - 2 : i;
            const Hull &mine = s.hull[which], &other = s.hull[1 - which];
            const Vector n = mine.normal[f], corner = mine.corner(f, 0);
            float least = INFINITY;
            for (int v = 0; v < 2 * other.c; ++v)
                least = wp::min(least, n.dot(other.vertex[v] - corner));
            first.offer(which ? -INFINITY : least, f);
            second.offer(which ? least : -INFINITY, f);
        }
        first = best(first);
        second = best(second);
    }
