"""PlatformIO hands build_flags to the compiler alone; the sanitizers have to be linked, too."""

Import("env")  # noqa: F821

env.Append(LINKFLAGS=["-fsanitize=address,undefined"])  # noqa: F821
