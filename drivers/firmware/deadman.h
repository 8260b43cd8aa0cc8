/* Dead-man: it has run out once nobody has fed it for `limit` ticks, and stays so until it is armed again. */
#ifndef DEADMAN_H
#define DEADMAN_H

#include <stdint.h>

typedef struct {
    uint32_t limit, silent;
    uint8_t ran_out;
} deadman;

static inline void deadman_arm(deadman *d, uint32_t limit)
{
    d->limit = limit;
    d->silent = 0;
    d->ran_out = 0;
}

static inline void deadman_feed(deadman *d)
{
    d->silent = 0;
}

/* Once per tick; return whether it has run out. */
static inline uint8_t deadman_tick(deadman *d)
{
    if (!d->ran_out && ++d->silent >= d->limit)
        d->ran_out = 1;
    return d->ran_out;
}

#endif
