"""Build a program for this computer."""

from SCons.Script import AlwaysBuild, Default, DefaultEnvironment

env = DefaultEnvironment()
env.Replace(AR="gcc-ar", RANLIB="gcc-ranlib", SIZETOOL="size", ARFLAGS=["rc"])
program = env.BuildProgram()
run = env.VerboseAction('"$BUILD_DIR/${PROGNAME}" $PROGRAM_ARGS', "Running $SOURCE")
AlwaysBuild(env.Alias("exec", program, run))
env.AddPlatformTarget("upload", program, run, "Execute")
Default(program)
