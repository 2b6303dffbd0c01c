/* Chebyshev convolutions, and the dense layers at the latent vector, on blocks of 16 states; with their gradients.
 *
 * A state's block is laid out as [node][channel][lane], lane = 0 .. 15 (the states of the block); all arrays are
 * contiguous. The powers L^k x of a block, k > 0, stand behind each other: [power - 1][node][channel][lane]. Weights
 * are those of the powers of L, ordered as each function says. `docs/speed.md` has the measurements;
 * `surrogates/operators/graph.py` has the same operations in torch, which are used where this file could not be compiled and
 * against which it is tested.
 *
 * Compiled for float and double by including itself.
 */
#ifndef REAL

#include <stdint.h>

#define LANES 16
#define NODES_AT_ONCE 32 /* as many as stay in the nearest cache while their products are summed */
#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)

/* One copy of each entry point for every width of vector registers, chosen when the library is loaded. */
#if defined(__x86_64__) && defined(__linux__) && defined(__GNUC__) && !defined(__clang__)
#define ENTRY __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default"))) void
#else
#define ENTRY void
#endif
#define INLINE static inline __attribute__((always_inline))

/* The graph's operator L: CSR, symmetric. */
struct graph {
    int64_t nodes;
    const int32_t *start, *column;
    const void *value;
};

/* One convolution y = sum_k L^k x V_k + bias, then ELU if `elu`. If `narrow_in`, x moves along the graph before its
 * channels are mixed, otherwise the mixed channels move: whichever are fewer.
 * forward   V as (out, order, in) if narrow_in, else as (order, out, in); `backward` is its transpose
 * x, y      all blocks of input and result
 * moved     [block][power - 1]..: the powers of x if narrow_in, which the gradient needs again; else room for the others
 */
struct layer {
    int64_t order, width_in, width_out, narrow_in, elu;
    const void *forward, *backward, *bias;
    const void *x;
    void *y, *moved;
};

#define REAL float
#define WHOLE int32_t
#define NAME(name) JOIN(name, _f32)
#define MANTISSA 23
#define BIAS 127
#define LOWEST -87.0f
#define EXP_TERMS 7
#include "_convolution.c"
#undef REAL
#undef WHOLE
#undef NAME
#undef MANTISSA
#undef BIAS
#undef LOWEST
#undef EXP_TERMS

#define REAL double
#define WHOLE int64_t
#define NAME(name) JOIN(name, _f64)
#define MANTISSA 52
#define BIAS 1023
#define LOWEST -708.0
#define EXP_TERMS 13
#include "_convolution.c"

#else

#define vec NAME(vec)
#define whole NAME(whole)
typedef REAL vec __attribute__((vector_size(LANES * sizeof(REAL)), aligned(sizeof(REAL)), may_alias));
typedef WHOLE whole __attribute__((vector_size(LANES * sizeof(REAL)), aligned(sizeof(REAL)), may_alias));

/* Where `mask` (all bits set or none) a, elsewhere b. */
#define CHOOSE(mask, a, b) ((vec)(((whole)(a) & (mask)) | ((whole)(b) & ~(mask))))

/* e^x for x <= 0: 2^k e^g with |g| <= ln(2) / 2 by its series. */
INLINE vec NAME(exponential)(vec x)
{
    const vec lowest = (vec){} + (REAL)LOWEST;
    x = CHOOSE(x < lowest, lowest, x);
    whole k = __builtin_convertvector(x * (REAL)1.4426950408889634 - (REAL)0.5, whole);
    vec g = x - __builtin_convertvector(k, vec) * (REAL)0.6931471805599453;
    vec sum = (vec){} + (REAL)1;
    for (int j = EXP_TERMS; j > 0; j--)
        sum = sum * g * ((REAL)1 / j) + (REAL)1;
    return sum * (vec)((k + BIAS) << MANTISSA);
}

INLINE vec NAME(elu)(vec x)
{
    vec zero = (vec){};
    return CHOOSE(x > zero, x, NAME(exponential)(CHOOSE(x > zero, zero, x)) - (REAL)1);
}

/* out = L x, added to `out` if `add`; then + bias (channel) if given, then ELU if `elu`. */
INLINE void NAME(product)(const struct graph *g, int64_t channels, const REAL *restrict x, REAL *restrict out, int add,
                          const REAL *restrict bias, int elu)
{
    const REAL *restrict value = g->value;
    for (int64_t i = 0; i < g->nodes; i++) {
        vec *y = (vec *)(out + i * channels * LANES);
        for (int64_t c = 0; c < channels; c += 3) { /* three channels at a time stay in registers */
            const int64_t left = channels - c;
            vec a = {0}, b = {0}, d = {0};
            if (add) {
                a = y[c];
                if (left > 1) b = y[c + 1];
                if (left > 2) d = y[c + 2];
            }
            for (int32_t p = g->start[i]; p < g->start[i + 1]; p++) {
                const vec *from = (const vec *)(x + g->column[p] * channels * LANES) + c;
                a += value[p] * from[0];
                if (left > 1) b += value[p] * from[1];
                if (left > 2) d += value[p] * from[2];
            }
            if (bias) {
                a += bias[c];
                if (left > 1) b += bias[c + 1];
                if (left > 2) d += bias[c + 2];
            }
            y[c] = elu ? NAME(elu)(a) : a;
            if (left > 1) y[c + 1] = elu ? NAME(elu)(b) : b;
            if (left > 2) y[c + 2] = elu ? NAME(elu)(d) : d;
        }
    }
}

/* L x .. L^(order-1) x at `rest`. */
INLINE void NAME(powers)(const struct graph *g, int64_t order, int64_t channels, const REAL *x, REAL *rest)
{
    const int64_t size = g->nodes * channels * LANES;
    for (int64_t k = 1; k < order; k++)
        NAME(product)(g, channels, k > 1 ? rest + (k - 2) * size : x, rest + (k - 1) * size, 0, 0, 0);
}

/* c_0 becomes sum_k L^k c_k, then with bias and ELU; the other c_k, at `rest`, are used up. */
INLINE void NAME(horner)(const struct graph *g, int64_t order, int64_t channels, REAL *c, REAL *rest, const REAL *bias,
                         int elu)
{
    const int64_t size = g->nodes * channels * LANES;
    for (int64_t k = order - 1; k > 1; k--)
        NAME(product)(g, channels, rest + (k - 1) * size, rest + (k - 2) * size, 1, 0, 0);
    NAME(product)(g, channels, rest, c, 1, bias, elu);
}

/* The channels of each node mixed:
 * out[q][i][o] = bias[o] + sum over p, c of weight[q][o][p][c] x[p][i][c], then ELU if `elu`.
 * p = 0 .. powers_in - 1, q = 0 .. powers_out - 1. */
INLINE void NAME(mix_few)(const REAL *restrict weight, int64_t row, int64_t powers, int64_t channels,
                          const REAL *restrict x, const REAL *restrict rest, int64_t stride,
                          const REAL *restrict bias, int elu, vec *restrict out, const int rows)
{
    vec sum[6] = {{0}};
    for (int r = 0; r < rows; r++)
        sum[r] = (vec){} + (bias ? bias[r] : (REAL)0);
    for (int64_t p = 0; p < powers; p++) {
        const vec *from = (const vec *)(p ? rest + (p - 1) * stride : x);
        const REAL *w = weight + p * channels;
        for (int64_t c = 0; c < channels; c++)
#pragma GCC unroll 6
            for (int r = 0; r < rows; r++)
                sum[r] += w[r * row + c] * from[c];
    }
    for (int r = 0; r < rows; r++)
        out[r] = elu ? NAME(elu)(sum[r]) : sum[r];
}

INLINE void NAME(mix)(int64_t n, int64_t powers_in, int64_t channels_in, int64_t powers_out, int64_t channels_out,
                      const REAL *restrict weight, const REAL *restrict x, const REAL *restrict x_rest,
                      REAL *restrict out, REAL *restrict out_rest, const REAL *restrict bias, int elu)
{
    const int64_t row = powers_in * channels_in, step = channels_in * LANES, step_out = channels_out * LANES;
    for (int64_t i = 0; i < n; i++) {
        const REAL *from = x + i * step, *rest = x_rest + i * step;
        for (int64_t q = 0; q < powers_out; q++) {
            vec *to = (vec *)(q ? out_rest + ((q - 1) * n + i) * step_out : out + i * step_out);
            for (int64_t o = 0; o < channels_out;) {
                const int64_t rows = channels_out - o >= 6 ? 6 : channels_out - o >= 3 ? 3 : 1;
                const REAL *w = weight + (q * channels_out + o) * row, *b = bias ? bias + o : 0;
                if (rows == 6)
                    NAME(mix_few)(w, row, powers_in, channels_in, from, rest, n * step, b, elu, to + o, 6);
                else if (rows == 3)
                    NAME(mix_few)(w, row, powers_in, channels_in, from, rest, n * step, b, elu, to + o, 3);
                else
                    NAME(mix_few)(w, row, powers_in, channels_in, from, rest, n * step, b, elu, to + o, 1);
                o += rows;
            }
        }
    }
}

/* The gradient behind an ELU with the result y: out = gradient (y > 0 ? 1 : y + 1), or a copy where y is missing; and
 * its sum over nodes, added to `lanes` [channel][lane]. */
INLINE vec NAME(behind_elu)(vec gradient, vec y)
{
    const vec one = (vec){} + (REAL)1;
    return gradient * CHOOSE(y > (vec){}, one, y + one);
}

INLINE void NAME(behind)(int64_t n, int64_t channels, const REAL *restrict gradient, const REAL *restrict y,
                         REAL *restrict out, REAL *restrict lanes)
{
    for (int64_t i = 0; i < n; i++)
        for (int64_t c = 0; c < channels; c++) {
            const int64_t at = (i * channels + c) * LANES;
            vec g = *(const vec *)(gradient + at);
            if (y) g = NAME(behind_elu)(g, *(const vec *)(y + at));
            *(vec *)(out + at) = g;
            ((vec *)lanes)[c] += g;
        }
}

INLINE REAL NAME(sum)(vec x)
{
    REAL total = 0;
    for (int lane = 0; lane < LANES; lane++)
        total += x[lane];
    return total;
}

/* out[p][a][q][b] += sum over i and lanes of x[p][i][a] y[q][i][b]. */
INLINE void NAME(gram_few)(int64_t nodes, const REAL *restrict x, int64_t step_x, const REAL *restrict y,
                           int64_t step_y, REAL *restrict out, int64_t row, const int rows, const int columns)
{
    vec sum[6][3] = {{{0}}};
    for (int64_t i = 0; i < nodes; i++) {
        const vec *a = (const vec *)(x + i * step_x), *b = (const vec *)(y + i * step_y);
#pragma GCC unroll 6
        for (int r = 0; r < rows; r++)
#pragma GCC unroll 3
            for (int s = 0; s < columns; s++)
                sum[r][s] += a[r] * b[s];
    }
    for (int r = 0; r < rows; r++)
        for (int s = 0; s < columns; s++)
            out[r * row + s] += NAME(sum)(sum[r][s]);
}

INLINE void NAME(gram)(int64_t n, int64_t powers_x, int64_t channels_x, const REAL *restrict x,
                       const REAL *restrict x_rest, int64_t powers_y, int64_t channels_y, const REAL *restrict y,
                       const REAL *restrict y_rest, REAL *restrict out)
{
    const int64_t row = powers_y * channels_y, step_x = channels_x * LANES, step_y = channels_y * LANES;
    for (int64_t first = 0; first < n; first += NODES_AT_ONCE) {
        const int64_t nodes = n - first < NODES_AT_ONCE ? n - first : NODES_AT_ONCE;
        for (int64_t p = 0; p < powers_x; p++)
            for (int64_t q = 0; q < powers_y; q++) {
                const REAL *from_x = (p ? x_rest + (p - 1) * n * step_x : x) + first * step_x;
                const REAL *from_y = (q ? y_rest + (q - 1) * n * step_y : y) + first * step_y;
                REAL *to = out + p * channels_x * row + q * channels_y;
                for (int64_t a = 0; a < channels_x;) {
                    const int64_t rows = channels_x - a >= 6 ? 6 : channels_x - a >= 3 ? 3 : 1;
                    for (int64_t b = 0; b < channels_y;) {
                        const int64_t columns = channels_y - b >= 3 ? 3 : 1;
                        const REAL *u = from_x + a * LANES, *v = from_y + b * LANES;
                        REAL *sum = to + a * row + b;
                        if (rows == 6 && columns == 3)
                            NAME(gram_few)(nodes, u, step_x, v, step_y, sum, row, 6, 3);
                        else if (rows == 6)
                            NAME(gram_few)(nodes, u, step_x, v, step_y, sum, row, 6, 1);
                        else if (rows == 3 && columns == 3)
                            NAME(gram_few)(nodes, u, step_x, v, step_y, sum, row, 3, 3);
                        else if (rows == 3)
                            NAME(gram_few)(nodes, u, step_x, v, step_y, sum, row, 3, 1);
                        else if (columns == 3)
                            NAME(gram_few)(nodes, u, step_x, v, step_y, sum, row, 1, 3);
                        else
                            NAME(gram_few)(nodes, u, step_x, v, step_y, sum, row, 1, 1);
                        b += columns;
                    }
                    a += rows;
                }
            }
    }
}

/* All layers of a stack, for blocks first .. last - 1. */
ENTRY NAME(stack_forward)(const struct graph *g, int64_t layers, const struct layer *layer, int64_t first, int64_t last)
{
    const int64_t lanes = g->nodes * LANES;
    for (int64_t block = first; block < last; block++)
        for (const struct layer *l = layer; l < layer + layers; l++) {
            const int64_t a = l->width_in, b = l->width_out, k = l->order, width = l->narrow_in ? a : b;
            const REAL *x = (const REAL *)l->x + block * lanes * a;
            REAL *y = (REAL *)l->y + block * lanes * b, *moved = (REAL *)l->moved + block * (k - 1) * lanes * width;
            if (l->narrow_in) {
                NAME(powers)(g, k, a, x, moved);
                NAME(mix)(g->nodes, k, a, 1, b, l->forward, x, moved, y, 0, l->bias, l->elu);
            } else {
                NAME(mix)(g->nodes, 1, a, k, b, l->forward, x, 0, y, moved, 0, 0);
                NAME(horner)(g, k, b, y, moved, l->bias, l->elu);
            }
        }
}

/* Its gradient, for blocks first .. last - 1.
 * gradient   of the last layer's y, all blocks
 * by_x       room for that of the first layer's x, all blocks; or none
 * by_weight  for each layer one behind the other: the gradient by `forward`, added to what is there
 * by_bias    likewise [out][lane]
 * room       [2 + order - 1][node][widest][lane] */
ENTRY NAME(stack_backward)(const struct graph *g, int64_t layers, const struct layer *layer, int64_t first,
                           int64_t last, const REAL *gradient, REAL *by_x, REAL *by_weight, REAL *by_bias, REAL *room,
                           int64_t widest)
{
    const int64_t n = g->nodes, lanes = n * LANES;
    REAL *given_room = room, *behind = room + lanes * widest, *rest = room + 2 * lanes * widest;
    for (int64_t block = first; block < last; block++) {
        const REAL *given = gradient + block * lanes * layer[layers - 1].width_out;
        REAL *weight = by_weight, *bias = by_bias;
        for (const struct layer *l = layer; l < layer + layers; l++) {
            weight += l->order * l->width_in * l->width_out;
            bias += l->width_out * LANES;
        }
        for (const struct layer *l = layer + layers - 1; l >= layer; l--) {
            const int64_t a = l->width_in, b = l->width_out, k = l->order;
            const REAL *x = (const REAL *)l->x + block * lanes * a, *y = (const REAL *)l->y + block * lanes * b;
            const REAL *moved = (const REAL *)l->moved + block * (k - 1) * lanes * (l->narrow_in ? a : b);
            REAL *to = l > layer ? given_room : by_x ? by_x + block * lanes * a : 0;
            weight -= k * a * b;
            bias -= b * LANES;
            NAME(behind)(n, b, given, l->elu ? y : 0, behind, bias);
            if (l->narrow_in) {
                NAME(gram)(n, 1, b, behind, 0, k, a, x, moved, weight);
                if (to) {
                    NAME(mix)(n, 1, b, k, a, l->backward, behind, 0, to, rest, 0, 0);
                    if (k > 1) NAME(horner)(g, k, a, to, rest, 0, 0);
                }
            } else {
                NAME(powers)(g, k, b, behind, rest);
                NAME(gram)(n, k, b, behind, rest, 1, a, x, 0, weight);
                if (to) NAME(mix)(n, k, b, 1, a, l->backward, behind, rest, to, 0, 0, 0);
            }
            given = to;
        }
    }
}

/* The dense layers, for entries first .. last - 1 of the `size` = nodes * channels that a block has, and all blocks.
 * h [block][entry][lane], z [block][latent][lane]; weight[m * step_m + r * step_r]. */

/* z += W h */
ENTRY NAME(shrink)(int64_t first, int64_t last, int64_t blocks, int64_t size, int64_t latent, const REAL *restrict weight,
                   int64_t step_m, int64_t step_r, const REAL *restrict h, REAL *restrict z)
{
    for (int64_t block = 0; block < blocks; block++)
        for (int64_t r = 0; r < latent; r += 4) { /* four sums stay in registers */
            const int64_t left = latent - r;
            const REAL *w = weight + r * step_r;
            const vec *from = (const vec *)h + block * size;
            vec a = {0}, b = {0}, c = {0}, d = {0};
            for (int64_t m = first; m < last; m++) {
                const REAL *u = w + m * step_m;
                a += u[0] * from[m];
                if (left > 1) b += u[step_r] * from[m];
                if (left > 2) c += u[2 * step_r] * from[m];
                if (left > 3) d += u[3 * step_r] * from[m];
            }
            vec *to = (vec *)z + block * latent + r;
            to[0] += a;
            if (left > 1) to[1] += b;
            if (left > 2) to[2] += c;
            if (left > 3) to[3] += d;
        }
}

/* by_h = W^T by_z, by_weight = sum over blocks and lanes of by_z h */
ENTRY NAME(shrink_gradient)(int64_t first, int64_t last, int64_t blocks, int64_t size, int64_t latent,
                            const REAL *restrict weight, int64_t step_m, int64_t step_r, const REAL *restrict h,
                            const REAL *restrict by_z, REAL *restrict by_h, REAL *restrict by_weight)
{
    for (int64_t m = first; m < last; m++) {
        for (int64_t block = 0; block < blocks && by_h; block++) {
            vec total = {0};
            for (int64_t r = 0; r < latent; r++)
                total += weight[m * step_m + r * step_r] * ((const vec *)by_z)[block * latent + r];
            ((vec *)by_h)[block * size + m] = total;
        }
        for (int64_t r = 0; r < latent; r++) {
            vec total = {0};
            for (int64_t block = 0; block < blocks; block++)
                total += ((const vec *)by_z)[block * latent + r] * ((const vec *)h)[block * size + m];
            by_weight[m * step_m + r * step_r] = NAME(sum)(total);
        }
    }
}

/* h = ELU(W z + bias) */
ENTRY NAME(expand)(int64_t first, int64_t last, int64_t blocks, int64_t size, int64_t latent, const REAL *restrict weight,
                   int64_t step_m, int64_t step_r, const REAL *restrict bias, const REAL *restrict z, REAL *restrict h)
{
    for (int64_t block = 0; block < blocks; block++)
        for (int64_t m = first; m < last; m++) {
            vec total = (vec){} + bias[m];
            for (int64_t r = 0; r < latent; r++)
                total += weight[m * step_m + r * step_r] * ((const vec *)z)[block * latent + r];
            ((vec *)h)[block * size + m] = NAME(elu)(total);
        }
}

/* by_weight and by_bias (entry) of `expand`, by_z added to what is there. */
ENTRY NAME(expand_gradient)(int64_t first, int64_t last, int64_t blocks, int64_t size, int64_t latent,
                            const REAL *restrict weight, int64_t step_m, int64_t step_r, const REAL *restrict z,
                            const REAL *restrict h, const REAL *restrict by_h, REAL *restrict by_z,
                            REAL *restrict by_weight, REAL *restrict by_bias)
{
    for (int64_t m = first; m < last; m++) {
        vec all = {0};
        for (int64_t r = 0; r < latent; r += 4) {
            const int64_t left = latent - r;
            const REAL *w = weight + m * step_m + r * step_r;
            vec a = {0}, b = {0}, c = {0}, d = {0};
            for (int64_t block = 0; block < blocks; block++) {
                const int64_t at = block * size + m;
                const vec g = NAME(behind_elu)(((const vec *)by_h)[at], ((const vec *)h)[at]);
                const vec *from = (const vec *)z + block * latent + r;
                vec *to = (vec *)by_z + block * latent + r;
                if (r == 0) all += g;
                a += g * from[0], to[0] += w[0] * g;
                if (left > 1) b += g * from[1], to[1] += w[step_r] * g;
                if (left > 2) c += g * from[2], to[2] += w[2 * step_r] * g;
                if (left > 3) d += g * from[3], to[3] += w[3 * step_r] * g;
            }
            REAL *out = by_weight + m * step_m + r * step_r;
            out[0] = NAME(sum)(a);
            if (left > 1) out[step_r] = NAME(sum)(b);
            if (left > 2) out[2 * step_r] = NAME(sum)(c);
            if (left > 3) out[3 * step_r] = NAME(sum)(d);
        }
        by_bias[m] = NAME(sum)(all);
    }
}

#undef vec
#undef whole
#undef CHOOSE
#endif
