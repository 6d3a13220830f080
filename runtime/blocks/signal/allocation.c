#include "allocation.h"

#include <math.h>
#include <string.h>

enum { AXES = ALLOCATION_AXES, MOST = ALLOCATION_MOST };

/* Below it a number beside 1 is rounding. */
static const double tolerance = 1e-9;

static void cross(const double a[AXES], const double b[AXES], double out[AXES])
{
    for (int i = 0; i < AXES; i++)
        out[i] = a[(i + 1) % AXES] * b[(i + 2) % AXES] - a[(i + 2) % AXES] * b[(i + 1) % AXES];
}

static double dot(const double a[AXES], const double b[AXES])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static double length(const double a[AXES])
{
    return sqrt(dot(a, a));
}

/* Of three columns; exactly zero if they lie in a plane. */
static double determinant(const double a[AXES], const double b[AXES], const double c[AXES])
{
    double normal[AXES];
    cross(b, c, normal);
    double found = dot(a, normal);
    return fabs(found) <= tolerance * length(a) * length(b) * length(c) ? 0 : found;
}

static void add_facets(struct allocation *allocation, const double a[AXES], const double b[AXES])
{
    struct allocation_facets facets = {.along = 0};
    cross(a, b, facets.normal);
    if (length(facets.normal) <= tolerance * length(a) * length(b))
        return;
    double all = 0;
    for (uint32_t i = 0; i < allocation->count; i++) {
        double made = determinant(allocation->column[i], a, b);
        facets.along += fmax(made, 0);
        facets.against += fmax(-made, 0);
        all += fabs(made);
    }
    /* What lies in a facet has room for rounding. */
    facets.along += 1e-3 * tolerance * all;
    facets.against += 1e-3 * tolerance * all;
    allocation->facets[allocation->facet_count++] = facets;
}

/* Whether thruster `other` is at 1 where `basis` is optimal: its cost less that of the basis's thrusters in its place
 * is negative. That is judged by the four's linear dependence, Σ factor_i·a_i = 0, computed in the order of their
 * numbers: then all bases of these four judge alike, whatever rounding does. */
static bool is_full(const struct allocation *allocation, const uint32_t basis[AXES], uint32_t other)
{
    uint32_t four[AXES + 1], place = 0;
    for (int i = 0; i < AXES; i++)
        place += basis[i] < other;
    for (uint32_t i = 0; i <= AXES; i++)
        four[i] = i < place ? basis[i] : i == place ? other : basis[i - 1];
    double factor[AXES + 1], cost = 0, size = 0, first = 0;
    for (uint32_t i = 0; i <= AXES; i++) {
        const double *rest[AXES];
        for (uint32_t j = 0; j < AXES; j++)
            rest[j] = allocation->column[four[j < i ? j : j + 1]];
        factor[i] = (i % 2 ? -1 : 1) * determinant(rest[0], rest[1], rest[2]);
        cost += factor[i];
        size += fabs(factor[i]);
        if (first == 0)
            first = factor[i];
    }
    if (fabs(cost) <= tolerance * size) /* of equal cost: the first costs infinitesimally more */
        cost = first;
    return (cost < 0) != (factor[place] < 0);
}

static void add_tile(struct allocation *allocation, const uint32_t basis[AXES])
{
    const double *a = allocation->column[basis[0]], *b = allocation->column[basis[1]],
                 *c = allocation->column[basis[2]];
    double size = determinant(a, b, c), full[AXES] = {0};
    if (size == 0)
        return;
    struct allocation_tile *tile = &allocation->tiles[allocation->tile_count++];
    *tile = (struct allocation_tile){.thruster = {basis[0], basis[1], basis[2]}};
    /* The rows of the inverse are cross products over the determinant. */
    cross(b, c, tile->inverse[0]);
    cross(c, a, tile->inverse[1]);
    cross(a, b, tile->inverse[2]);
    for (int i = 0; i < AXES; i++)
        for (int j = 0; j < AXES; j++)
            tile->inverse[i][j] /= size;
    for (uint32_t i = 0; i < allocation->count; i++) {
        if (i == basis[0] || i == basis[1] || i == basis[2] || !is_full(allocation, basis, i))
            continue;
        tile->full |= 1u << i;
        for (int axis = 0; axis < AXES; axis++)
            full[axis] += allocation->column[i][axis];
    }
    for (int i = 0; i < AXES; i++)
        tile->offset[i] = dot(tile->inverse[i], full);
}

void allocation_prepare(struct allocation *allocation)
{
    allocation->facet_count = allocation->tile_count = 0;
    for (uint32_t a = 0; a < allocation->count; a++)
        for (uint32_t b = a + 1; b < allocation->count; b++) {
            add_facets(allocation, allocation->column[a], allocation->column[b]);
            for (uint32_t c = b + 1; c < allocation->count; c++)
                add_tile(allocation, (const uint32_t[AXES]){a, b, c});
        }
}

bool allocation_makes(const struct allocation *allocation, const double direction[AXES])
{
    for (uint32_t i = 0; i < allocation->facet_count; i++) {
        const struct allocation_facets *facets = &allocation->facets[i];
        double far = dot(facets->normal, direction), near = tolerance * length(facets->normal) * length(direction);
        double all = facets->along + facets->against;
        if ((far > near && facets->along <= tolerance * all) || (far < -near && facets->against <= tolerance * all))
            return false;
    }
    return allocation->facet_count > 0;
}

/* The greatest s up to 1. The fraction limit/far stands for it, which takes no division for each facet. */
static double reach(const struct allocation *allocation, const double wanted[AXES])
{
    double least_limit = 1, least_far = 1;
    for (uint32_t i = 0; i < allocation->facet_count; i++) {
        const struct allocation_facets *facets = &allocation->facets[i];
        double along = dot(facets->normal, wanted), far = fabs(along);
        double limit = along > 0 ? facets->along : facets->against;
        if (limit * least_far < least_limit * far) {
            least_limit = limit;
            least_far = far;
        }
    }
    return least_limit / least_far;
}

double allocate(const struct allocation *allocation, const double wanted[AXES], double duty[MOST])
{
    double s = reach(allocation, wanted), made[AXES], best[AXES] = {0}, least_outside = INFINITY;
    const struct allocation_tile *in = NULL;
    for (int axis = 0; axis < AXES; axis++)
        made[axis] = s * wanted[axis];
    for (uint32_t i = 0; i < allocation->tile_count; i++) {
        const struct allocation_tile *tile = &allocation->tiles[i];
        double u[AXES], outside = -1;
        for (int j = 0; j < AXES; j++) {
            u[j] = dot(tile->inverse[j], made) - tile->offset[j];
            outside = -u[j] > outside ? -u[j] : outside; /* fmax() is a call */
            outside = u[j] - 1 > outside ? u[j] - 1 : outside;
        }
        /* Because of rounding, a point between tiles may be in none: the nearest one. */
        if (outside < least_outside) {
            least_outside = outside;
            in = tile;
            memcpy(best, u, sizeof u);
        }
    }
    for (uint32_t i = 0; i < allocation->count; i++)
        duty[i] = in && in->full >> i & 1;
    for (int i = 0; in && i < AXES; i++)
        duty[in->thruster[i]] = best[i] < tolerance ? 0 : fmin(best[i], 1);
    return s;
}
