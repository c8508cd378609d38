"""Models, policies and solutions in and out: files, arrays, environments of others."""
