int polarmpm_native_version(void) { return 1; }
