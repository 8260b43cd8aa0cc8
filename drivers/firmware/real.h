/* The type of the laws' numbers: single precision on the device, double precision where it is checked bit by bit. */
#ifndef REAL_H
#define REAL_H

#ifndef REAL
#define REAL float
#endif
typedef REAL real;

#endif
