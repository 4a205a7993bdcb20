// How functions are to be called on the AVR, whose compiler inlines by its own lights.
#ifndef RELPOS_INERTIAL_CALLS_H
#define RELPOS_INERTIAL_CALLS_H

// Kept as one copy that is called: inlined or cloned it would undo what it is for. A method so kept
// reaches its object by a pointer, two bytes an access, not by its address, four. Each was measured.
#if defined(__AVR__)
#define RELPOS_SHARED __attribute__((noinline, noclone))
// Called from one place, yet not inlined there: its variables are on the stack only while it runs.
#define RELPOS_APART __attribute__((noinline))
// May be inlined, but has no copies for the values that it is called with.
#define RELPOS_UNCLONED __attribute__((noclone))
#else
#define RELPOS_SHARED
#define RELPOS_APART
#define RELPOS_UNCLONED
#endif

#endif
