// How a function becomes visible in the shared library: extern "C" MUDG_API int mudg_something(...).
#pragma once

#if defined(_WIN32)
#define MUDG_API __declspec(dllexport)
#else
#define MUDG_API __attribute__((visibility("default")))
#endif

// Raised whenever the layout of a struct or the meaning of an argument of any mudg_* function changes;
// native/__init__.py refuses a library with another number.
#define MUDG_ABI_VERSION 6
