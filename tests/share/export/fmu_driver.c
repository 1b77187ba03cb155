/* The life of two instances of an FMU of the decay u' = -k u, for sanitizers; its log goes to stdout.
 * With -DFMI=3 the FMU is of version 3.0, otherwise of 2.0.
 */
#include <stdio.h>
#include <stdlib.h>

#if FMI == 3
#include "fmi3_interface.h"

#define CALL(name) fmi3##name
typedef fmi3Instance instance;
typedef fmi3FMUState saved;
typedef fmi3Byte byte;

static void logger(fmi3InstanceEnvironment environment, fmi3Status status, fmi3String category,
                   fmi3String message)
{
    (void)environment;
    printf("any %d %s: %s\n", (int)status, category, message);
}

static instance made(const char *name, const char *token)
{
    return fmi3InstantiateCoSimulation(name, token, "", 0, 1, 0, 0, NULL, 0, NULL, logger, NULL);
}

static instance made_otherwise(const char *token)
{
    return fmi3InstantiateModelExchange("x", token, "", 0, 1, NULL, logger);
}

static void begin(instance one, double stop)
{
    fmi3EnterInitializationMode(one, 0, 0, 0, 1, stop);
}

static int step(instance one, double at, double size)
{
    fmi3Boolean event, end, early;
    fmi3Float64 reached;
    const fmi3Status status = fmi3DoStep(one, at, size, 1, &event, &end, &early, &reached);

    if (status == fmi3Discard)
        printf("%d %d %d %.4f\n", event, end, early, reached);
    return status;
}

static int get(instance one, const unsigned *what, size_t count, double *values)
{
    return fmi3GetFloat64(one, what, count, values, count);
}

static int set(instance one, unsigned what, double value)
{
    return fmi3SetFloat64(one, &what, 1, &value, 1);
}

static int get_whole(instance one, unsigned what)
{
    fmi3Int32 value;
    return fmi3GetInt32(one, &what, 1, &value, 1);
}

static int slope(instance one, unsigned row, unsigned column, double *value)
{
    const double seed = 1;
    return fmi3GetDirectionalDerivative(one, &row, 1, &column, 1, &seed, 1, value, 1);
}

#define SerializedSize fmi3SerializedFMUStateSize
#define Serialize fmi3SerializeFMUState
#define Deserialize fmi3DeserializeFMUState
#define GetState fmi3GetFMUState
#define SetState fmi3SetFMUState
#define FreeState fmi3FreeFMUState
#else
#include "fmi2_interface.h"

#define CALL(name) fmi2##name
typedef fmi2Component instance;
typedef fmi2FMUstate saved;
typedef fmi2Byte byte;

static void logger(fmi2ComponentEnvironment environment, fmi2String name, fmi2Status status,
                   fmi2String category, fmi2String message, ...)
{
    (void)environment;
    printf("%s %d %s: %s\n", name, (int)status, category, message);
}

static const fmi2CallbackFunctions callbacks = {logger, calloc, free, NULL, NULL};

static instance made(const char *name, const char *token)
{
    return fmi2Instantiate(name, fmi2CoSimulation, token, "", &callbacks, 0, 0);
}

static instance made_otherwise(const char *token)
{
    return fmi2Instantiate("x", fmi2ModelExchange, token, "", &callbacks, 0, 0);
}

static void begin(instance one, double stop)
{
    fmi2SetupExperiment(one, 0, 0, 0, 1, stop);
    fmi2EnterInitializationMode(one);
}

static int step(instance one, double at, double size)
{
    const fmi2Status status = fmi2DoStep(one, at, size, 1);
    fmi2Boolean end;
    fmi2Real reached;

    if (status == fmi2Discard && fmi2GetBooleanStatus(one, fmi2Terminated, &end) == fmi2OK &&
        fmi2GetRealStatus(one, fmi2LastSuccessfulTime, &reached) == fmi2OK)
        printf("0 %d 0 %.4f\n", end, reached);
    return status;
}

static int get(instance one, const unsigned *what, size_t count, double *values)
{
    return fmi2GetReal(one, what, count, values);
}

static int set(instance one, unsigned what, double value)
{
    return fmi2SetReal(one, &what, 1, &value);
}

static int get_whole(instance one, unsigned what)
{
    fmi2Integer value;
    return fmi2GetInteger(one, &what, 1, &value);
}

static int slope(instance one, unsigned row, unsigned column, double *value)
{
    const double seed = 1;
    return fmi2GetDirectionalDerivative(one, &row, 1, &column, 1, &seed, value);
}

#define SerializedSize fmi2SerializedFMUstateSize
#define Serialize fmi2SerializeFMUstate
#define Deserialize fmi2DeSerializeFMUstate
#define GetState fmi2GetFMUstate
#define SetState fmi2SetFMUstate
#define FreeState fmi2FreeFMUstate
#endif

static void show(instance one)
{
    const unsigned all[] = {0, 1, 2};
    double values[3];

    if (get(one, all, 3, values) == 0)
        printf("t=%.4f k=%.4f u=%.4f\n", values[0], values[1], values[2]);
}

/* A state as bytes, set in another instance. */
static int carried_over(instance from, instance to)
{
    saved state = NULL, copy = NULL;
    size_t size = 0;
    byte *bytes;
    int status = GetState(from, &state) || SerializedSize(from, state, &size);

    bytes = malloc(size);
    if (status || bytes == NULL)
        return 1;
    status = Serialize(from, state, bytes, size) || Deserialize(to, bytes, size, &copy) ||
             SetState(to, copy);
    free(bytes);
    FreeState(from, &state);
    FreeState(to, &copy);
    return status;
}

int main(int count, char **arguments)
{
    const char *const token = count > 1 ? arguments[1] : "";
    saved state = NULL;
    instance first, second;
    double value;

    if (made("x", "wrong") != NULL || made_otherwise(token) != NULL || made("", token) != NULL)
        return 1;
    first = made("first", token);
    second = made("second", token);
    if (first == NULL || second == NULL)
        return 1;
    begin(first, 2);
    CALL(ExitInitializationMode)(first);
    GetState(first, &state);
    step(first, 0, 1);
    show(first);
    SetState(first, state);
    GetState(first, &state);
    FreeState(first, &state);
    FreeState(first, &state);
    set(first, 1, 1);
    show(first);
    set(first, 1, 99);
    get_whole(first, 1);
    step(first, 0, 5);
    step(second, 0, 1);
    if (slope(first, 2, 1, &value) == 0)
        printf("%.4f\n", value);
    step(first, 0, 0.5);
    if (carried_over(first, second) != 0)
        return 1;
    show(second);
    CALL(Reset)(first);
    show(first);
    CALL(FreeInstance)(first);
    CALL(FreeInstance)(second);
    CALL(FreeInstance)(NULL);
    return 0;
}
