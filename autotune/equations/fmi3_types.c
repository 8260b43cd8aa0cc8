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
