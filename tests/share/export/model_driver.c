/* Evaluates the model at points from standard input, as text is slow: raw doubles both ways.
 *
 * in:  count, then for each point the time and the parameters
 * out: for each point the unknowns, then their derivatives; at last the unknowns of one batch
 */
#include <stdio.h>
#include <stdlib.h>

#include "model.h"

static void *reserve(size_t count)
{
    void *memory = calloc(count ? count : 1, sizeof(model_real));
    if (!memory)
        exit(10);
    return memory;
}

int main(void)
{
    const size_t d = MODEL_PARAMETERS, n = MODEL_UNKNOWNS;
    double header, number;
    size_t count, k, j;
    model_real *p, *t, *u, *g;

    if (fread(&header, sizeof header, 1, stdin) != 1)
        return 11;
    count = (size_t)header;
    p = reserve(count * d);
    t = reserve(count);
    u = reserve(count * n);
    g = reserve(n * (d + 1));
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
        for (j = 0; j < n * (d + 2); j++) {
            number = j < n ? u[j] : g[j - n];
            fwrite(&number, sizeof number, 1, stdout);
        }
    }
    if (model_eval_batch(count, p, t, u))
        return 14;
    for (j = 0; j < count * n; j++) {
        number = u[j];
        fwrite(&number, sizeof number, 1, stdout);
    }
    free(p);
    free(t);
    free(u);
    free(g);
    return 0;
}
