// Last part of the body of the function that `search_kernel.py` hands to Warp: the contacts of one pair, from arrays and
// into arrays.

enum { FRAME = 9 };

#if defined(__CUDA_ARCH__)
__shared__ PairMemory s;
#elif WP_TILE_BLOCK_DIM > 1
static PairMemory s;  // of all fibers
#else
if (lane > 0)  // launched for a warp; here one lane does all the work
    return;
PairMemory s;
#endif

const int from = pair / pairs * geoms, first = from + geom.data[2 * pair], second = from + geom.data[2 * pair + 1];
const Pair search { { lane }, s };
const Geom a { vertex.data + 3 * VERTICES * first, face_normal.data + 3 * FACES * first, rotation.data + 9 * first,
               Vector::of(place.data + 3 * first) };
const Geom b { vertex.data + 3 * VERTICES * second, face_normal.data + 3 * FACES * second, rotation.data + 9 * second,
               Vector::of(place.data + 3 * second) };
const Vector shift = a.shift - b.shift;
const bool is_plane = planes != 0;
const float reach = radius.data[second] + (is_plane ? 0.0f : radius.data[first]);
const float height = -shift.dot({ a.turn[2], a.turn[5], a.turn[8] });  // over a plane
Vector normal { 1.0f, 0.0f, 0.0f };
bool found = false;
if (reach > 0.0f && (is_plane ? height < reach : shift.square() < reach * reach))
    found = search.find(a, b, is_plane, normal);
SHARE(k, 0, EACH) {
    const bool touches = found && s.depth[k] < 0.0f;
    const int at = EACH * pair + k;
    distance.data[at] = touches ? s.depth[k] : APART;
    (touches ? s.where[k] + b.shift : Vector { 0.0f, 0.0f, 0.0f }).to(position.data + 3 * at);
    (found ? normal.unit() : Vector { 1.0f, 0.0f, 0.0f }).frame(frame.data + FRAME * at);
}
#undef SHARE
