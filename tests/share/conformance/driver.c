/* Asks a model at points of a file: raw doubles both ways, as text is slow.
 *
 * in:  count, then for each point the time and the parameters
 * out: for each point the unknowns, then their derivatives; the unknowns of one batch; with -DASK_EVENTS
 *      for each point times of events and the end, with -DASK_BRANCHES also the order that holds;
 *      ranges; for each coordinate what is returned below, above, and where it is not a number.
 *      Names go to the other stream, one a line: unknowns, parameters, events of instants.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "model.h"

#define WIDTH (1 + MODEL_PARAMETERS)

static void put(double number)
{
    fwrite(&number, sizeof number, 1, stdout);
}

static void *reserve(size_t count)
{
    void *memory = calloc(count ? count : 1, sizeof(model_real));
    if (!memory)
        exit(10);
    return memory;
}

/* What becomes of a point with one coordinate elsewhere; 20 if anything was written all the same. */
static int refused(const model_real *p, model_real t, size_t j, model_real value, model_real *u,
                   model_real *g)
{
    model_real *q = reserve(WIDTH);
    int status;
    size_t i;

#if MODEL_PARAMETERS > 0
    for (i = 0; i < MODEL_PARAMETERS; i++)
        q[i] = p[i];
    if (j > 0)
        q[j - 1] = value;
#else
    (void)p;
#endif
    if (j == 0)
        t = value;
    for (i = 0; i < MODEL_UNKNOWNS; i++)
        u[i] = 7;
    status = model_eval(q, t, u);
    if (model_eval_batch(1, q, &t, u) != status || model_gradient(q, t, g) != status)
        status = 21;
    for (i = 0; i < MODEL_UNKNOWNS; i++)
        if (!(u[i] == 7))
            status = 20;
    free(q);
    return status;
}

int main(void)
{
    const size_t d = MODEL_PARAMETERS, n = MODEL_UNKNOWNS;
    double header, number;
    size_t count, k, j;
    model_real *p, *t, *u, *g, low, high;

    if (fread(&header, sizeof header, 1, stdin) != 1)
        return 11;
    count = (size_t)header;
    p = reserve(count * d);
    t = reserve(count);
    u = reserve(count * n);
    g = reserve(n * WIDTH);
    for (k = 0; k < count; k++)
        for (j = 0; j <= d; j++) {
            if (fread(&number, sizeof number, 1, stdin) != 1)
                return 12;
            if (j == 0)
                t[k] = (model_real)number;
            else
                p[k * d + j - 1] = (model_real)number;
        }
    for (k = 0; k < count; k++) {
        if (model_eval(p + k * d, t[k], u) || model_gradient(p + k * d, t[k], g))
            return 13;
        for (j = 0; j < n; j++)
            put(u[j]);
        for (j = 0; j < n * WIDTH; j++)
            put(g[j]);
    }
    if (model_eval_batch(count, p, t, u))
        return 14;
    for (j = 0; j < count * n; j++)
        put(u[j]);
#ifdef ASK_EVENTS
    {
        int i;
        model_real times[MODEL_INSTANTS + 1], end;

        for (k = 0; k < count; k++) {
            if (model_event_times(p + k * d, times) || model_end(p + k * d, &end))
                return 15;
            for (i = 0; i < MODEL_INSTANTS; i++)
                put(times[i]);
            put(end);
        }
    }
#endif
#ifdef ASK_BRANCHES
    for (k = 0; k < count; k++) {
        int order;

        if (model_branch(p + k * d, &order))
            return 16;
        put(order);
    }
#endif
    for (j = 0; j < WIDTH; j++) {
        put(j == 0 ? model_time_lower : model_lower[j - 1]);
        put(j == 0 ? model_time_upper : model_upper[j - 1]);
    }
    for (j = 0; j < WIDTH; j++) {
        low = j == 0 ? model_time_lower : model_lower[j - 1];
        high = j == 0 ? model_time_upper : model_upper[j - 1];
        put(refused(p, t[0], j, low - (high - low), u, g));
        put(refused(p, t[0], j, high + (high - low), u, g));
        put(refused(p, t[0], j, (model_real)NAN, u, g));
    }
    for (j = 0; j < n; j++)
        fprintf(stderr, "%s\n", model_unknown_names[j]);
    for (j = 0; j < d; j++)
        fprintf(stderr, "%s\n", model_parameter_names[j]);
#ifdef ASK_EVENTS
    {
        int i;

        for (i = 0; i < MODEL_INSTANTS; i++)
            fprintf(stderr, "%s\n", model_instant_names[i]);
    }
#endif
    free(p);
    free(t);
    free(u);
    free(g);
    return 0;
}
