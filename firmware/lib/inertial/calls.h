// How functions are to be called on the AVR, whose compiler inlines by its own lights.
#ifndef RELPOS_INERTIAL_CALLS_H
#define RELPOS_INERTIAL_CALLS_H

// Kept as one copy that is called: inlined or cloned it would undo what it is for. A method so kept
// reaches its object by a pointer, two bytes an access, not by its address, four. Each was measured.
// A relative call reaches 4 KB and is two bytes shorter than an absolute one. The linker, which sorts
// the sections by name, puts the float library between .text.a and .text.near.
#if defined(__AVR__)
#define RELPOS_SHARED __attribute__((noinline, noclone, section(".text.a")))
// Called from one place, yet not inlined there: its variables are on the stack only while it runs.
#define RELPOS_APART __attribute__((noinline))
// The same, beside the float library.
#define RELPOS_NEAR __attribute__((noinline, section(".text.near")))
#else
#define RELPOS_SHARED
#define RELPOS_APART
#define RELPOS_NEAR
#endif

#endif
