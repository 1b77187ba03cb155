/* The life of two instances of an FMU of the decay u' = -k u, for sanitizers; its log goes to stdout. */
#include <stdio.h>
#include <stdlib.h>

#include "fmi2_interface.h"

static void logger(fmi2ComponentEnvironment environment, fmi2String name, fmi2Status status,
                   fmi2String category, fmi2String message, ...)
{
    (void)environment;
    (void)category;
    printf("%s %d: %s\n", name ? name : "", (int)status, message);
}

static void show(fmi2Component c)
{
    const fmi2ValueReference all[] = {0, 1, 2};
    fmi2Real values[3];

    if (fmi2GetReal(c, all, 3, values) == fmi2OK)
        printf("t=%.4f k=%.4f u=%.4f\n", values[0], values[1], values[2]);
}

int main(int count, char **arguments)
{
    const fmi2CallbackFunctions callbacks = {logger, calloc, free, NULL, NULL};
    const fmi2ValueReference k = 1, u = 2;
    const fmi2Real wrong = 99, one = 1;
    const char *const token = count > 1 ? arguments[1] : "";
    fmi2FMUstate state = NULL;
    fmi2Component first, second;
    fmi2Integer whole;
    fmi2Real slope;

    if (fmi2Instantiate("x", fmi2CoSimulation, "wrong", "", &callbacks, 0, 0) != NULL ||
        fmi2Instantiate("x", fmi2ModelExchange, token, "", &callbacks, 0, 0) != NULL ||
        fmi2Instantiate("", fmi2CoSimulation, token, "", &callbacks, 0, 0) != NULL)
        return 1;
    first = fmi2Instantiate("first", fmi2CoSimulation, token, "", &callbacks, 0, 0);
    second = fmi2Instantiate("second", fmi2CoSimulation, token, "", &callbacks, 0, 0);
    if (first == NULL || second == NULL)
        return 1;
    fmi2SetupExperiment(first, 0, 0, 0, 1, 2);
    fmi2EnterInitializationMode(first);
    fmi2ExitInitializationMode(first);
    fmi2GetFMUstate(first, &state);
    fmi2DoStep(first, 0, 1, 1);
    show(first);
    fmi2SetFMUstate(first, state);
    fmi2GetFMUstate(first, &state);
    fmi2FreeFMUstate(first, &state);
    fmi2FreeFMUstate(first, &state);
    fmi2SetReal(first, &k, 1, &one);
    show(first);
    fmi2SetReal(first, &k, 1, &wrong);
    fmi2GetInteger(first, &k, 1, &whole);
    fmi2DoStep(first, 0, 5, 1);
    fmi2DoStep(second, 0, 1, 1);
    if (fmi2GetDirectionalDerivative(first, &u, 1, &k, 1, &one, &slope) == fmi2OK)
        printf("%.4f\n", slope);
    fmi2Reset(first);
    show(first);
    fmi2FreeInstance(first);
    fmi2FreeInstance(second);
    fmi2FreeInstance(NULL);
    return 0;
}
