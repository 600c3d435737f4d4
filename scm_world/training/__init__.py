"""Training of policies: by reward, and by imitation."""
