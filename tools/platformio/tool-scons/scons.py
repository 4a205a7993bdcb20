"""SCons as PyPI packages it, where PlatformIO looks for its own copy."""

import SCons.Script

SCons.Script.main()
