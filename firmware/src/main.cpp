// Placeholder: the node engineer's wiring replaces it.
#if defined(ARDUINO)
#include <Arduino.h>
void setup() {}
void loop() {}
#else
int main() { return 0; }
#endif
