"""What a policy that remembers its cost attains, layer by layer of the cost paid."""
