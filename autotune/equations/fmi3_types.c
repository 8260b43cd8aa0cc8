/* What the parts of an FMU's source have in common, with no header but the compiler's own. */
#include <math.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif
typedef unsigned int Reference;
typedef enum { OK, WARNING, DISCARD, ERROR, FATAL } Status;

typedef struct {
    double *t, *value;
    size_t count, room;
} History;

static Status append(History *past, double t, double value)
{
    if (past->count == past->room) {
        size_t room = past->room ? 2 * past->room : 64;
        double *times = realloc(past->t, room * sizeof *times);
        if (times) past->t = times;
        double *values = realloc(past->value, room * sizeof *values);
        if (values) past->value = values;
        if (!times || !values) return ERROR;
        past->room = room;
    }
    past->t[past->count] = t;
    past->value[past->count++] = value;
    return OK;
}
