/* SPDX-FileCopyrightText: RISE-DI contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * The controller as a co-simulation unit of FMI 2.0. A step of the unit is a tick: y and y_m have the stamp of the begin of the step,
 * and u is valid after the step. Parameters of the law may change between two steps: the next step checks them. Source: FMI 2.0.5,
 * sections 2.1 and 4.2. Value references: modelDescription.xml.
 */
#include <stddef.h>
#include <string.h>

#include "rise_di.c"
#include "rise_di_table.c"

#ifdef _WIN32
#define EXPORTED __declspec(dllexport)
#else
#define EXPORTED
#endif

enum { Y = 0, Y_M = 100, U = 200, ACTIVE = 300, Y_NEW = 301, Y_M_NEW = 302, MODE = 400, PARAMETER = 1000 };
#define LONGEST 9e9 /* s, 285 years: what int64_t holds in ns */

enum { OK = 0, DISCARD = 2, ERROR = 3 };
#define REALS ((sizeof(rise_di_parameters) - offsetof(rise_di_parameters, period)) / sizeof(rise_di_real))

typedef struct {
    void (*logger)(void *, const char *, int, const char *, const char *, ...);
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
    void (*step_finished)(void *, int);
    void *environment;
} callbacks;

typedef struct {
    rise_di_controller controller;
    rise_di_parameters parameters[2]; /* those in force, at the index `flown`, and those before */
    rise_di_parameters wanted;        /* with the values of the importer */
    int flown, edited;
    rise_di_real y[RISE_DI_M], y_m[RISE_DI_M];
    int active, y_new, y_m_new;
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
} unit;

static const rise_di_parameters exported = RISE_DI_PARAMETERS;

EXPORTED const char *fmi2GetTypesPlatform(void);
EXPORTED const char *fmi2GetVersion(void);
EXPORTED int fmi2SetDebugLogging(unit *, int, size_t, const char *const *);
EXPORTED unit *fmi2Instantiate(const char *, int, const char *, const char *, const callbacks *, int, int);
EXPORTED void fmi2FreeInstance(unit *);
EXPORTED int fmi2SetupExperiment(unit *, int, double, double, int, double);
EXPORTED int fmi2EnterInitializationMode(unit *);
EXPORTED int fmi2ExitInitializationMode(unit *);
EXPORTED int fmi2Terminate(unit *);
EXPORTED int fmi2Reset(unit *);
EXPORTED int fmi2GetReal(unit *, const unsigned *, size_t, double *);
EXPORTED int fmi2GetInteger(unit *, const unsigned *, size_t, int *);
EXPORTED int fmi2GetBoolean(unit *, const unsigned *, size_t, int *);
EXPORTED int fmi2GetString(unit *, const unsigned *, size_t, const char **);
EXPORTED int fmi2SetReal(unit *, const unsigned *, size_t, const double *);
EXPORTED int fmi2SetInteger(unit *, const unsigned *, size_t, const int *);
EXPORTED int fmi2SetBoolean(unit *, const unsigned *, size_t, const int *);
EXPORTED int fmi2SetString(unit *, const unsigned *, size_t, const char *const *);
EXPORTED int fmi2DoStep(unit *, double, double, int);
EXPORTED int fmi2CancelStep(unit *);
EXPORTED int fmi2GetFMUstate(unit *, unit **);
EXPORTED int fmi2SetFMUstate(unit *, const unit *);
EXPORTED int fmi2FreeFMUstate(unit *, unit **);
EXPORTED int fmi2SerializedFMUstateSize(unit *, const unit *, size_t *);
EXPORTED int fmi2SerializeFMUstate(unit *, const unit *, char *, size_t);
EXPORTED int fmi2DeSerializeFMUstate(unit *, const char *, size_t, unit **);
/* The unit does not offer these functions, so modelDescription.xml does not have their flags. But FMI 2.0 wants every function to
 * exist. */
EXPORTED int fmi2GetDirectionalDerivative(unit *, const unsigned *, size_t, const unsigned *, size_t, const double *, double *);
EXPORTED int fmi2SetRealInputDerivatives(unit *, const unsigned *, size_t, const int *, const double *);
EXPORTED int fmi2GetRealOutputDerivatives(unit *, const unsigned *, size_t, const int *, double *);
EXPORTED int fmi2GetStatus(unit *, int, int *);
EXPORTED int fmi2GetRealStatus(unit *, int, double *);
EXPORTED int fmi2GetIntegerStatus(unit *, int, int *);
EXPORTED int fmi2GetBooleanStatus(unit *, int, int *);
EXPORTED int fmi2GetStringStatus(unit *, int, const char **);

const char *fmi2GetTypesPlatform(void) { return "default"; }

const char *fmi2GetVersion(void) { return "2.0"; }

int fmi2SetDebugLogging(unit *u, int on, size_t count, const char *const *categories) {
    (void)u, (void)on, (void)count, (void)categories;
    return OK;
}

int fmi2Reset(unit *u) {
    bool started;
    u->parameters[0] = exported;
    u->wanted = exported;
    u->flown = u->edited = 0;
    started = rise_di_start(&u->controller, &u->parameters[0]);
    fill(u->y, RISE_DI_M, ZERO);
    fill(u->y_m, RISE_DI_M, ZERO);
    u->active = u->y_new = u->y_m_new = 1;
    return started ? OK : ERROR;
}

unit *fmi2Instantiate(const char *name, int type, const char *guid, const char *resources, const callbacks *functions, int visible,
                      int logging) {
    unit *u = functions->allocate(1, sizeof(unit));
    (void)name, (void)guid, (void)resources, (void)visible, (void)logging;
    if (type != 1) { /* fmi2CoSimulation */
        return NULL;
    }
    if (u != NULL) {
        u->allocate = functions->allocate;
        u->release = functions->release;
        if (fmi2Reset(u) != OK) {
            functions->release(u);
            u = NULL;
        }
    }
    return u;
}

void fmi2FreeInstance(unit *u) {
    if (u != NULL) {
        u->release(u);
    }
}

int fmi2SetupExperiment(unit *u, int tolerance_defined, double tolerance, double start, int stop_defined, double stop) {
    (void)u, (void)tolerance_defined, (void)tolerance, (void)start, (void)stop_defined, (void)stop;
    return OK;
}

int fmi2EnterInitializationMode(unit *u) { return (void)u, OK; }

int fmi2ExitInitializationMode(unit *u) { return (void)u, OK; }

int fmi2Terminate(unit *u) { return (void)u, OK; }

int fmi2CancelStep(unit *u) { return (void)u, ERROR; }

/* The place of an input, or NULL if the reference is not known. */
static rise_di_real *input_of(unit *u, unsigned reference) {
    rise_di_real *const groups[2] = {u->y, u->y_m};
    const unsigned group = reference / 100, i = reference % 100;
    return (group < 2 && i < RISE_DI_M) ? &groups[group][i] : NULL;
}

/* The place of a parameter among the values of the importer, or NULL if the reference is not known. */
static rise_di_real *parameter_of(unit *u, unsigned reference) {
    return (reference >= PARAMETER && reference - PARAMETER < REALS) ? &(&u->wanted.period)[reference - PARAMETER] : NULL;
}

/* The place of a real variable, or NULL if the reference is not known. */
static const rise_di_real *real_of(unit *u, unsigned reference) {
    const rise_di_real *place = input_of(u, reference);
    if (reference >= PARAMETER) {
        place = parameter_of(u, reference);
    } else if (reference >= U && reference < U + RISE_DI_COMMANDS) {
        place = &rise_di_command(&u->controller)[reference - U];
    }
    return place;
}

/* Take the parameters of the importer, if it has changed any. They replace those that are no longer in force. Returns false if one
 * of them is out of its bounds. */
static bool are_taken(unit *u) {
    if (u->edited && rise_di_check(&u->wanted) == NULL) {
        u->wanted.digest = u->parameters[u->flown].digest + 1;
        u->flown = 1 - u->flown;
        u->parameters[u->flown] = u->wanted;
        rise_di_retune(&u->controller, &u->parameters[u->flown]);
        u->edited = 0;
    }
    return !u->edited;
}

static int *boolean_of(unit *u, unsigned reference) {
    int *const places[3] = {&u->active, &u->y_new, &u->y_m_new};
    return (reference >= ACTIVE && reference <= Y_M_NEW) ? places[reference - ACTIVE] : NULL;
}

int fmi2GetReal(unit *u, const unsigned *references, size_t count, double *values) {
    for (size_t i = 0; i < count; i++) {
        const rise_di_real *place = real_of(u, references[i]);
        if (place == NULL) {
            return ERROR;
        }
        values[i] = (double)*place;
    }
    return OK;
}

int fmi2SetReal(unit *u, const unsigned *references, size_t count, const double *values) {
    for (size_t i = 0; i < count; i++) {
        rise_di_real *place = references[i] >= PARAMETER ? parameter_of(u, references[i]) : input_of(u, references[i]);
        if (place == NULL) {
            return ERROR;
        }
        *place = (rise_di_real)values[i];
        u->edited = u->edited || references[i] >= PARAMETER;
    }
    return OK;
}

int fmi2GetInteger(unit *u, const unsigned *references, size_t count, int *values) {
    for (size_t i = 0; i < count; i++) {
        if (references[i] != MODE) {
            return ERROR;
        }
        values[i] = (int)u->controller.mode;
    }
    return OK;
}

int fmi2SetInteger(unit *u, const unsigned *references, size_t count, const int *values) {
    (void)u, (void)references, (void)values;
    return count == 0 ? OK : ERROR;
}

int fmi2GetBoolean(unit *u, const unsigned *references, size_t count, int *values) {
    for (size_t i = 0; i < count; i++) {
        const int *place = boolean_of(u, references[i]);
        if (place == NULL) {
            return ERROR;
        }
        values[i] = *place;
    }
    return OK;
}

int fmi2SetBoolean(unit *u, const unsigned *references, size_t count, const int *values) {
    for (size_t i = 0; i < count; i++) {
        int *place = boolean_of(u, references[i]);
        if (place == NULL) {
            return ERROR;
        }
        *place = values[i];
    }
    return OK;
}

int fmi2GetString(unit *u, const unsigned *references, size_t count, const char **values) {
    (void)u, (void)references, (void)values;
    return count == 0 ? OK : ERROR;
}

int fmi2SetString(unit *u, const unsigned *references, size_t count, const char *const *values) {
    (void)u, (void)references, (void)values;
    return count == 0 ? OK : ERROR;
}

int fmi2DoStep(unit *u, double t, double step_size, int no_set_state) {
    int64_t now_ns;
    rise_di_status of_y = RISE_DI_TAKEN, of_y_m = RISE_DI_TAKEN;
    rise_di_output output;
    (void)step_size, (void)no_set_state;
    if (!(t > -LONGEST && t < LONGEST) || !are_taken(u)) {
        return DISCARD;
    }
    now_ns = (int64_t)((t * 1e9) + 0.5);
    if (u->y_m_new) {
        of_y_m = rise_di_take_y_m(&u->controller, now_ns, now_ns, u->y_m);
    }
    if (u->y_new) {
        of_y = rise_di_take_y(&u->controller, now_ns, now_ns, u->y);
    }
    (void)rise_di_tick(&u->controller, now_ns, u->active != 0, &output);
    return (of_y == RISE_DI_TAKEN && of_y_m == RISE_DI_TAKEN) ? OK : DISCARD;
}

int fmi2GetFMUstate(unit *u, unit **state) {
    if (*state == NULL) {
        *state = u->allocate(1, sizeof(unit));
    }
    if (*state == NULL) {
        return ERROR;
    }
    **state = *u;
    return OK;
}

int fmi2SetFMUstate(unit *u, const unit *state) {
    void *(*const allocate)(size_t, size_t) = u->allocate;
    void (*const release)(void *) = u->release;
    *u = *state;
    u->allocate = allocate;
    u->release = release;
    u->controller.parameters = &u->parameters[u->flown];
    return OK;
}

int fmi2FreeFMUstate(unit *u, unit **state) {
    if (*state != NULL) {
        u->release(*state);
    }
    *state = NULL;
    return OK;
}

int fmi2SerializedFMUstateSize(unit *u, const unit *state, size_t *size) {
    (void)u, (void)state;
    *size = sizeof(unit);
    return OK;
}

int fmi2SerializeFMUstate(unit *u, const unit *state, char *bytes, size_t size) {
    (void)u;
    if (size < sizeof(unit)) {
        return ERROR;
    }
    memcpy(bytes, state, sizeof(unit));
    return OK;
}

int fmi2DeSerializeFMUstate(unit *u, const char *bytes, size_t size, unit **state) {
    if (size != sizeof(unit) || fmi2GetFMUstate(u, state) != OK) {
        return ERROR;
    }
    memcpy(*state, bytes, sizeof(unit));
    return OK;
}

int fmi2GetDirectionalDerivative(unit *u, const unsigned *of, size_t of_count, const unsigned *by, size_t by_count,
                                 const double *seed, double *values) {
    return (void)u, (void)of, (void)of_count, (void)by, (void)by_count, (void)seed, (void)values, ERROR;
}

int fmi2SetRealInputDerivatives(unit *u, const unsigned *of, size_t count, const int *orders, const double *values) {
    return (void)u, (void)of, (void)count, (void)orders, (void)values, ERROR;
}

int fmi2GetRealOutputDerivatives(unit *u, const unsigned *of, size_t count, const int *orders, double *values) {
    return (void)u, (void)of, (void)count, (void)orders, (void)values, ERROR;
}

int fmi2GetStatus(unit *u, int kind, int *value) { return (void)u, (void)kind, (void)value, DISCARD; }

int fmi2GetRealStatus(unit *u, int kind, double *value) { return (void)u, (void)kind, (void)value, DISCARD; }

int fmi2GetIntegerStatus(unit *u, int kind, int *value) { return (void)u, (void)kind, (void)value, DISCARD; }

int fmi2GetBooleanStatus(unit *u, int kind, int *value) { return (void)u, (void)kind, (void)value, DISCARD; }

int fmi2GetStringStatus(unit *u, int kind, const char **value) { return (void)u, (void)kind, (void)value, DISCARD; }
