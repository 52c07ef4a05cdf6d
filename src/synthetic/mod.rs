//! Tunnels whose axis, surface, labels, colours and map are known in closed form.
