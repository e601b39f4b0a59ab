"""The numbers of a run, computed from what it recorded: formation, radio, commands, connectivity, agents, safety, missions.

Functions of tables and events: nothing is drawn, written or simulated here.

Formation error of a follower (Toh 2012, equations 3-31 and 3-34, for any slot): its handle,
``h = p_f + ell (cos th_f, sin th_f)``, should lie on the point ``r = p_l + Rot(th_l) (slot + (ell, 0))`` of its leader's frame;
``z = Rot(-th_f) (r - h)``. All poses are true ones, whatever the vehicles believed.

The schema ``vcmvsp.metrics/1``, as `Recorder.metrics` gives it. Keys may be added to it; none changes its meaning. Which keys
there are depends on the scenario and not on chance, but for the causes of losses. Where there is nothing to measure a value
is None, never NaN::

    schema, scenario, seed
    duration_s                      simulated time that the run lasted
    formation                       |z| at the recorded instants, in the plane; of a key marked *: of each link alone, too
      rms_m, mean_m, max_m *        over the window and all followers
      final_m *                     greatest at the last instant
      settling_s *                  from then on no follower is more than 5 cm off, to the end of the run
      overshoot *                   greatest of a follower; share of its start error (`responses`), of the whole run
      convergence_1_s *             slowest of a follower; 1/s, of the whole run
      hop_gain *                    greatest of a follower: RMS |z| of its link over RMS |z| of its leader's link, in the window
      shape_changes *               how often team leaders noted another shape; of one: how often it did (`changes`)
      mode_toggles *                how often followers noted that they began to get around something (mode avoid or turn), or
                                    had done so; None where none notes modes
      avoid_s *                     time that they spent doing so, added up; likewise; these and the next of the whole run
      reformed_s *                  from when the lane of a team's leader was free again to when all of the team are settled, to
                                    the end of the run; of several teams the longest
      shape                         misfit of the teams' centres and their shape (`shape`)
        rms_m, max_m                over the window
        final_m                     at the last instant
      per_follower.<name>           those marked *, of one
    radio                           of the whole run, but for the ages
      frames                        frames that entered the channel
      receptions, delivery_ratio    frames received, and their share of frame x receiver
      under_way                     how many had neither arrived nor been lost when the run ended: frame x receiver is the sum
                                    of receptions, losses and these
      losses.<cause>                how many were lost, by cause
      delay_s                       mean, p50, p95, p99, max; from sending to reception
      age_s                         of information, in the window (`ages`)
        mean, p95, max              at the agents' ticks
        time_average                over all time: exact area of the sawtooth
        peak                        mean of what the age had risen to before each reception that lowered it
    routing                         what the network layer did, of the whole run; only with routing (`routing`)
      messages                      of agents and programs
      arrivals, delivery_ratio      where they were meant to arrive, and their share of message x receiver; without what may
                                    still arrive when the run ends
      hops_mean, hops_max           frames on the way to an arrival
      delay_s                       mean, p50, p95, p99, max; from the origin's sending to the arrival
      forwarded                     frames with messages that others than their origins sent
      no_route                      messages that were not sent, because their origin knew no route
      control_frames, control_bytes   of updates of routes
    control                         commanded velocities, held from one to the next, in the window (`control`)
      speed_rms_m_s, yaw_rate_rms_rad_s
      acceleration_rms_m_s2, yaw_acceleration_rms_rad_s2
      effort_m2_s                   integral of the squared speed over time
      per_vehicle.<name>            the same of one
    connectivity                    of all vehicles by radio, in each second of the window (`connectivity`)
      mean, min                     of the algebraic connectivity
      connected_share               share of the seconds in which it is greater than 0
    agents.<vehicle>                each vehicle with an agent, of the whole run (`agents`)
      missed                        ticks at which the agent, lost or failed, did not act
      lost_s                        simulated time for which it was lost
      reconnects                    how often it came back, or another host in its place
      late                          answers that came too late to count
    hardware.<vehicle>              each real vehicle, of the whole run (`hardware`); only where there are any
      age_s                         of what its driver told last, at the instants of the run: p50, p99, max
      fix_age_s                     the same of the last position that counted
      sigma_m                       standard deviation of the estimated position, along its worse axis; likewise
      prediction_m                  how far off dead reckoning from one instant to the next was; likewise
      fixes, gated                  positions that came, and those of them that did not fit
      reconnects                    how often its link was lost and came back
      stops.<cause>                 how often it was stopped
      limited_s                     time in which it was told something else than its agent wanted
      limited_by_s.<cause>          of that, by cause; `limits` of speed and acceleration where nothing else held it back
      frames_too_early              receptions of its frames after a delay below its own median age: no real link is so quick
    safety
      collisions                    touches that began
      min_separation_m              smallest distance of two centres at a recorded instant
      min_clearance_m               likewise of a vehicle's reference point to a solid or an obstacle with a time-table
    mission                         of a reconnaissance (`mission`), of the whole run; only where the world has targets, or
                                    agents show something, or note a commander, a task or what they found
      targets_found                 targets that a vehicle confirmed within 3 m of their true places
      targets_tracked               targets near which, within 3 m, a vehicle that tracked them was for 10 s on end
      found_s.<target>              when it was first confirmed; None: never
      false_finds                   confirmations with no such target near
      area_seen_ratio               share of the searched area that a vehicle has looked at; None: nobody shows a map
      map_bytes_sent                payload of all messages with maps
      switches                      how often another algorithm took command of a vehicle
    digest                          SHA-256 of all that was recorded (`cosim.recording.accumulators`)
"""

SCHEMA = "vcmvsp.metrics/1"
