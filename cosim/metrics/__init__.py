"""The numbers of a run, computed from what it recorded: formation, radio, commands, connectivity, agents, safety, missions.

Functions of tables and events: nothing is drawn, written or simulated here. `catalogue` defines each number.

Formation error of a follower (Toh 2012, equations 3-31 and 3-34, for any slot): its handle,
``h = p_f + ell (cos th_f, sin th_f)``, should lie on the point ``r = p_l + Rot(th_l) (slot + (ell, 0))`` of its leader's frame;
``z = Rot(-th_f) (r - h)``. All poses are true ones, whatever the vehicles believed.
"""
