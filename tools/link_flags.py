"""PlatformIO hands build_flags to the compiler alone; these have to reach the linker, too."""

Import("env")  # noqa: F821

flags = " ".join(env["BUILD_FLAGS"]).split()  # noqa: F821
env.Append(LINKFLAGS=[f for f in flags if f.startswith(("-fsanitize", "--coverage"))])  # noqa: F821
